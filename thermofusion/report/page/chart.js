// Numbers as text, the legend with its histogram, a profile with its band.

const NS = "http://www.w3.org/2000/svg", BINS = 128;

/** value ± sigma, two digits of the sigma; a difference has its sign. */
export function told(value, sigma, signed = false) {
  if (value === undefined || !Number.isFinite(value)) return "–";
  const digits = Number.isFinite(sigma) && sigma > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 3) : 2;
  const sign = signed && value > 0 ? "+" : "";
  return `${sign}${value.toFixed(digits)}${Number.isFinite(sigma) ? ` ± ${sigma.toFixed(digits)}` : ""}`.replace(/-/g, "−");
}

/** Round marks from lo to hi. */
export function ticks(lo, hi, wanted) {
  const rough = (hi - lo) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((s) => s * power).reduce((a, b) => (Math.abs(Math.log(b / rough)) < Math.abs(Math.log(a / rough)) ? b : a));
  const out = [];
  for (let i = Math.ceil(lo / step - 1e-6); i * step <= hi + 1e-6 * step; i++) out.push(i * step);
  return { marks: out, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

/** Histogram over the range above the palette's bar, triangles where values lie beyond it. */
export function legend(canvas, values, rgba, lo, hi, title) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth || 512, h = canvas.clientHeight || 48, bar = 12, left = 10, right = w - 10;
  canvas.width = w * ratio;
  canvas.height = h * ratio;
  const g = canvas.getContext("2d");
  g.scale(ratio, ratio);
  const counts = new Float64Array(BINS);
  let below = false, above = false;
  for (let i = 0; i < values.length; i++) {
    const x = values[i];
    if (Number.isNaN(x)) continue;
    if (x < lo) below = true; else if (x > hi) above = true; else counts[Math.min(Math.floor(((x - lo) / (hi - lo)) * BINS), BINS - 1)]++;
  }
  const most = Math.max(...counts, 1), ink = getComputedStyle(canvas).color, top = h - bar - 16;
  g.fillStyle = ink;
  g.globalAlpha = 0.45;
  const across = (right - left) / BINS;
  counts.forEach((n, k) => g.fillRect(left + k * across, top - (n / most) * top, across + 0.5, (n / most) * top));
  g.globalAlpha = 1;
  for (let x = left; x < right; x += 1 / ratio) {
    const i = 4 * Math.round(((x - left) / (right - left)) * 255);
    g.fillStyle = `rgb(${rgba[i]},${rgba[i + 1]},${rgba[i + 2]})`;
    g.fillRect(x, top, 1 / ratio, bar);
  }
  const tip = (x, d, i) => { g.fillStyle = `rgb(${rgba[i]},${rgba[i + 1]},${rgba[i + 2]})`; g.strokeStyle = ink; g.beginPath(); g.moveTo(x, top); g.lineTo(x + d, top + bar / 2); g.lineTo(x, top + bar); g.closePath(); g.fill(); g.stroke(); };
  if (below) tip(left, -9, 0);
  if (above) tip(right, 9, 1020);
  g.fillStyle = ink;
  g.font = "11px sans-serif";
  g.textAlign = "center";
  const { marks, digits } = ticks(lo, hi, Math.min(6, w / 55));
  for (const m of marks) {
    const x = left + ((m - lo) / (hi - lo)) * (right - left);
    g.fillRect(x, top + bar, 1, 3);
    g.fillText(m.toFixed(digits), Math.min(Math.max(x, 14), w - 14), h - 1);
  }
  canvas.setAttribute("aria-label", `${title}: colours from ${lo} to ${hi}`);
}

/** Temperature along a line, with one sigma. */
export function chart({ mm, degC, sigma_K }) {
  const w = 320, h = 170, x0 = 40, x1 = w - 8, y0 = h - 24, y1 = 8;
  const known = mm.map((_, k) => k).filter((k) => Number.isFinite(degC[k]));
  const low = Math.min(...known.map((k) => degC[k] - sigma_K[k])), high = Math.max(...known.map((k) => degC[k] + sigma_K[k]));
  const pad = Math.max(0.05 * (high - low), 0.02), lo = low - pad, hi = high + pad, end = mm.at(-1) || 1;
  const X = (k) => x0 + (mm[k] / end) * (x1 - x0), Y = (v) => y0 - ((v - lo) / (hi - lo)) * (y0 - y1);
  const root = node("svg", { viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": `Temperature along ${end.toFixed(0)} mm, ${low.toFixed(2)} to ${high.toFixed(2)} °C` });
  const vertical = ticks(lo, hi, 4), level = ticks(0, end, 4);
  for (const v of vertical.marks) root.append(node("line", { class: "axis", x1: x0, x2: x1, y1: Y(v), y2: Y(v) }), node("text", { x: x0 - 4, y: Y(v) + 4, "text-anchor": "end" }, v.toFixed(vertical.digits)));
  for (const m of level.marks) root.append(node("text", { x: x0 + (m / end) * (x1 - x0), y: h - 8, "text-anchor": "middle" }, `${m.toFixed(level.digits)}${m === level.marks.at(-1) ? " mm" : ""}`));
  const band = [...known.map((k) => [X(k), Y(degC[k] + sigma_K[k])]), ...known.toReversed().map((k) => [X(k), Y(degC[k] - sigma_K[k])])];
  root.append(node("polygon", { class: "band", points: band.map((p) => p.join(",")).join(" ") }), node("polyline", { class: "line", points: known.map((k) => `${X(k)},${Y(degC[k])}`).join(" ") }));
  return root;
}

function node(tag, attributes, text) {
  const e = document.createElementNS(NS, tag);
  for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
  if (text) e.textContent = text;
  return e;
}
