// The report's screen: maps, colours, tools, tables. What is measured is defined in regions.js.

import { columns as load, facts } from "./data.js";
import { chart, legend, told } from "./chart.js";
import { Measurer } from "./regions.js";
import { Body3D } from "./scene.js";
import { Surface } from "./surface.js";

const $ = (id) => document.getElementById(id);
const NS = "http://www.w3.org/2000/svg";
const state = { map: 0, beside: -1, tool: "turn", regions: [], readings: [], differences: [], chosen: -1, ranges: [], palettes: [] };
let body, skin, columns, measurer, pointer = null;

const ready = start().catch((fault) => {
  $("fault").textContent = `The body cannot be drawn here (${fault.message}); the pictures and tables below are complete.`;
  throw fault;
});
ready.catch(() => {});
window.thermofusion = { ready, facts, view: (name) => body.view(name), map: choose, beside, range, pick, ray: (x, y) => body.ray(x, y), measure: (r) => measurer.read(r), add, regions: document_, table, rendered: () => body.render() };

async function start() {
  const probe = document.createElement("canvas").getContext("webgl2");
  if (!probe) throw new Error("this browser offers no WebGL 2");
  probe.getExtension("WEBGL_lose_context")?.loseContext();
  columns = await load();
  skin = new Surface(columns.position, columns.triangles);
  for (const id of ["controls", "stage", "tools", "panel"]) $(id).hidden = false;
  document.querySelector(".actions").hidden = false;
  body = new Body3D($("body"), skin, columns);
  $("pictures").classList.add("drawn");
  measurer = new Measurer(skin, columns, facts);
  facts.maps.forEach((m, k) => { state.ranges[k] = [...m.range]; state.palettes[k] = m.palette; });
  fill();
  body.onDraw = decorate;
  listen();
  choose(0);
  body.frusta(frusta());
  body.render();
  for (const region of facts.regions) add(region, false);
  requestIdleCallback?.(() => skin.bvh);
  return true;
}

// ------------------------------------------------------------ maps and colours

function values(k) {
  const m = facts.maps[k];
  if (m.kind === "color") return null;
  if (!m.values) {
    if (m.less) m.values = Float32Array.from(columns[m.column], (x, i) => x - columns[m.less][i]);
    else m.values = Float32Array.from(columns[m.column], (x, i) => (m.only && Number.isNaN(columns.temperature[i]) ? NaN : x));
    if (m.scale) m.values = m.values.map((x) => x * m.scale);
  }
  return m.values;
}

const tables = Object.fromEntries(Object.entries(facts.palettes).map(([name, text]) => {
  const rgb = Uint8Array.from(atob(text), (c) => c.charCodeAt(0)), rgba = new Uint8Array(1024).fill(255);
  for (let i = 0; i < 256; i++) rgba.set(rgb.subarray(3 * i, 3 * i + 3), 4 * i);
  return [name, rgba];
}));

function layer(k) {
  const m = facts.maps[k], [lo, hi] = state.ranges[k];
  return { values: values(k), palette: tables[state.palettes[k]], lo, hi, kind: m.kind };
}

function shown() {
  const pair = state.beside >= 0 ? [state.map, state.beside] : [state.map];
  body.show(pair.map(layer));
  const m = facts.maps[state.map], [lo, hi] = state.ranges[state.map];
  $("palette").value = state.palettes[state.map];
  $("low").value = +lo.toPrecision(6); $("high").value = +hi.toPrecision(6);
  for (const id of ["low", "high", "palette", "auto", "legend"]) $(id).hidden = m.kind === "color";
  if (m.kind !== "color") legend($("legend"), values(state.map), tables[state.palettes[state.map]], lo, hi, `${m.title}, ${m.unit}${facts.relative && m.level ? ", relative" : ""}`);
  $("pane-1").textContent = title(state.map);
  $("pane-2").textContent = state.beside >= 0 ? title(state.beside) : "";
}

const title = (k) => `${facts.maps[k].title}${facts.maps[k].unit ? `, ${facts.maps[k].unit}` : ""}${facts.relative && facts.maps[k].level ? " (relative)" : ""}`;

function number(map) {
  const k = typeof map === "number" ? map : facts.maps.findIndex((m) => m.id === map);
  if (k < 0 || k >= facts.maps.length) throw new Error(`there is no map '${map}'`);
  return k;
}

function choose(map) { state.map = number(map); $("map").value = String(state.map); shown(); }
function beside(map) { state.beside = map === null || map === -1 ? -1 : number(map); $("beside").value = String(state.beside); shown(); }

function range(lo, hi) {
  if (!(lo < hi)) return shown();
  state.ranges[state.map] = [lo, hi];
  // maps of the same kind of temperature stay comparable: they share a range
  if (facts.maps[state.map].level) facts.maps.forEach((m, k) => { if (m.level) state.ranges[k] = [lo, hi]; });
  shown();
}

function fill() {
  const option = (select, value, text) => select.append(new Option(text, value));
  option($("beside"), -1, "nothing");
  facts.maps.forEach((m, k) => { option($("map"), k, m.title); option($("beside"), k, m.title); });
  Object.keys(tables).forEach((name) => option($("palette"), name, name));
  if (!facts.cameras.length) $("cameras").closest("label").hidden = true;
}

// ------------------------------------------------------------ reading a point

function pick(x, y) {
  const found = body.pick(x, y);
  if (!found) return null;
  const at = (column) => found.corners.reduce((s, i, k) => s + found.weights[k] * column[i], 0);
  const nearest = found.corners[found.weights.indexOf(Math.max(...found.weights))];
  return {
    point: found.point, triangle: found.triangle, pane: found.pane, normal: skin.normal(nearest),
    temperature: at(columns.temperature), sigma: at(columns.sigma), angle: at(columns.angle),
    views: columns.count[nearest], flags: columns.flags[nearest],
    map: facts.maps[found.pane ? state.beside : state.map].kind === "color" ? NaN : at(values(found.pane ? state.beside : state.map)),
  };
}

function words(p) {
  if (!p) return "";
  if (Number.isNaN(p.temperature)) return "unmeasured";
  const m = facts.maps[p.pane ? state.beside : state.map], flags = facts.flags.filter((f) => p.flags & f.bit).map((f) => f.name);
  const parts = [`${told(p.temperature, p.sigma)} °C`, `${p.angle.toFixed(0)}°`, `${p.views} views`, ...flags];
  if (m.column !== "temperature" && !Number.isNaN(p.map)) parts.unshift(`${m.title} ${p.map.toFixed(m.digits)} ${m.unit}`);
  return parts.join(" · ");
}

function hover() {
  hover.waiting = false;
  $("readout").textContent = pointer && !stroke ? words(pick(...pointer)) : "";
}

// ------------------------------------------------------------ regions

function add(region, render = true) {
  const n = state.regions.length + 1;
  state.regions.push({ ...region, name: region.name || `${{ spot: "spot", line: "line" }[region.kind] ?? "region"} ${n}` });
  state.readings.push(measurer.read(state.regions.at(-1)));
  state.chosen = state.regions.length - 1;
  if (render !== null) listed();
  return state.readings.at(-1);
}

function remove(k) {
  state.regions.splice(k, 1); state.readings.splice(k, 1);
  state.chosen = Math.min(state.chosen, state.regions.length - 1);
  listed();
}

/** The same region on the other side: mirrored in the body's middle, put back onto the skin. */
function mirrored(region) {
  const c = 2 * body.centre[0], flip = ([x, y, z]) => [c - x, y, z], on = (p) => skin.nearest(flip(p)).point;
  const name = region.name.replace(/\b(left|right)\b/i, (s) => (s.toLowerCase() === "left" ? "right" : "left"));
  const copy = { ...region, name: name === region.name ? `${name}, mirrored` : name };
  if (region.kind === "spot") copy.point_m = on(region.point_m);
  if (region.kind === "line") copy.points_m = region.points_m.map(on);
  if (region.kind === "brush") Object.assign(copy, { points_m: region.points_m.map(on), normals: region.normals.map(([x, y, z]) => [-x, y, z]) });
  if (region.kind === "lasso") Object.assign(copy, { outline_m: region.outline_m.map(flip).reverse(), toward_viewer: [-region.toward_viewer[0], region.toward_viewer[1], region.toward_viewer[2]] });
  if (region.kind === "slab") Object.assign(copy, { point_m: flip(region.point_m), axis: [-region.axis[0], region.axis[1], region.axis[2]] });
  return copy;
}

function listed() {
  state.differences = measurer.differences(state.regions, state.readings);
  const rows = state.regions.map((region, k) => {
    const r = state.readings[k], row = make("tr", { "aria-selected": String(k === state.chosen) });
    const name = make("input", { value: region.name, "aria-label": `Name of ${k + 1}`, maxlength: 200, dir: "auto" });
    name.addEventListener("change", () => { region.name = r.name = name.value; listed(); });
    const button = (text, label, act) => { const b = make("button", { type: "button", "aria-label": `${label} ${k + 1}`, title: label }, text); b.addEventListener("click", act); return b; };
    row.append(make("td", {}, String(k + 1)), make("td", {}, name), make("td", { class: "n" }, told(r.value_degC, r.sigma_K)),
      make("td", {}, button("⇄", "Mirror", () => add(mirrored(region))), button("×", "Remove", () => remove(k))));
    row.addEventListener("click", (e) => { if (!e.target.closest("button")) { state.chosen = k; detail(); marks(); for (const x of $("list").rows) x.setAttribute("aria-selected", String(x === row)); } });
    return row;
  });
  for (const d of state.differences) {
    const far = Number.isNaN(d.distance_mm) ? "" : `, ${d.distance_mm.toFixed(0)} mm over the surface`;
    rows.push(make("tr", { class: "delta" }, make("td", {}, "Δ"), make("td", {}, make("bdi", {}, d.first), " − ", make("bdi", {}, d.second), far), make("td", { class: "n" }, told(d.delta_K, d.sigma_K, true)), make("td", {}, "K")));
  }
  $("list").tBodies[0].replaceChildren(...rows);
  $("empty").hidden = rows.length > 0;
  $("list").hidden = !rows.length;
  detail();
  marks();
}

function detail() {
  const r = state.readings[state.chosen];
  if (!r) return $("detail").replaceChildren();
  const items = [["mean", `${told(r.value_degC, r.sigma_K)} °C`]];
  if (r.kind === "spot") items[0][0] = "temperature";
  if (r.sigma_absolute_K > 0) items.push(["with the level", `± ${r.sigma_absolute_K.toFixed(2)} K`]);
  if ("sd_K" in r) items.push(["SD", `${r.sd_K.toFixed(2)} K`], ["lowest, highest", `${r.min_degC.toFixed(2)}, ${r.max_degC.toFixed(2)} °C`]);
  if ("area_cm2" in r) items.push(["area", `${r.area_cm2.toFixed(1)} cm²`]);
  if ("measured_fraction" in r) items.push(["measured", `${(100 * r.measured_fraction).toFixed(0)} %`]);
  if ("length_mm" in r) items.push(["length", `${r.length_mm.toFixed(1)} mm over the surface`]);
  items.push(["vertices", String(r.n)]);
  const list = make("dl", {}, ...items.flatMap(([a, b]) => [make("dt", {}, a), make("dd", {}, b)]));
  $("detail").replaceChildren(make("h3", {}, make("bdi", {}, state.regions[state.chosen].name)), list, ...(r.profile ? [chart(r.profile)] : []));
}

function marks() {
  body.lines(state.readings.flatMap((r) => r.segments ?? (r.line ? r.line.slice(1).flatMap((p, k) => [r.line[k], p]) : [])));
}

function document_() {
  return { schema: "thermofusion-regions/1", frame: "upright", software: facts.software, scan: facts.scan, regions: state.regions };
}

function table() {
  const keys = ["name", "kind", "value_degC", "sigma_K", "sigma_absolute_K", "sd_K", "min_degC", "max_degC", "n", "area_cm2", "measured_fraction", "length_mm"];
  const cell = (x) => (typeof x === "number" ? (Number.isFinite(x) ? String(+x.toPrecision(6)) : "") : `"${(/^[=+\-@\t\r]/.test(x) ? "'" + x : x).replace(/"/g, '""')}"`);
  const rows = state.readings.map((r) => keys.map((k) => cell(r[k] ?? NaN)).join(","));
  for (const d of state.differences) rows.push([cell(`${d.first} - ${d.second}`), "difference_K", cell(d.delta_K), cell(d.sigma_K), "", "", "", "", "", "", "", cell(d.distance_mm)].join(","));
  return [keys.join(","), ...rows, ""].join("\n");
}

async function loaded(file) {
  try {
    if (file.size > 20e6) throw new Error("it is too large");
    const tree = JSON.parse(await file.text());
    if (tree?.schema !== "thermofusion-regions/1" || tree.frame !== "upright" || !Array.isArray(tree.regions)) throw new Error("it is no regions file of this version");
    const numbers = (list) => Array.isArray(list) && list.length > 0 && list.length <= 20000 && list.every((p) => Array.isArray(p) && p.length === 3 && p.every(Number.isFinite));
    for (const r of tree.regions) {
      const good = { spot: () => numbers([r.point_m]), line: () => numbers(r.points_m) && r.points_m.length > 1, lasso: () => numbers(r.outline_m) && numbers([r.toward_viewer]),
        brush: () => numbers(r.points_m) && numbers(r.normals) && r.normals.length === r.points_m.length && r.radius_m > 0, slab: () => numbers([r.point_m, r.axis]) && r.length_m > 0 }[r?.kind]?.();
      if (!good) throw new Error("one of its regions is not understood");
    }
    for (const r of tree.regions) add({ ...r, name: String(r.name ?? "").slice(0, 200) }, null);
    $("fault").textContent = "";
    listed();
  } catch (fault) {
    $("fault").textContent = `The regions cannot be read: ${fault.message}.`;
  }
}

// ------------------------------------------------------------ tools

let stroke = null, down = null;

function tool(name) {
  state.tool = name;
  stroke = null;
  body.controls.enabled = name === "turn" || name === "spot" || name === "line";
  $("stage").classList.toggle("drawing", name !== "turn");
  for (const b of document.querySelectorAll("[data-tool]")) b.setAttribute("aria-pressed", String(b.dataset.tool === name));
  decorate();
}

const place = (e) => { const b = $("body").getBoundingClientRect(); return [e.clientX - b.left, e.clientY - b.top]; };

function pressed(e) {
  down = place(e);
  if (state.tool === "lasso" || state.tool === "brush") { stroke = []; $("body").setPointerCapture(e.pointerId); drawn(down); }
}

function drawn([x, y]) {
  const last = stroke.at(-1);
  if (last && Math.hypot(x - last.at[0], y - last.at[1]) < 3) return;
  if (state.tool === "lasso") {
    const ray = body.ray(x, y);
    stroke.push({ at: [x, y], point: ray.origin.map((o, k) => o + 2 * body.reach * ray.direction[k]), toward: ray.direction.map((d) => -d) });
  } else {
    const p = pick(x, y), radius = brushRadius();
    if (p && !stroke.some((s) => Math.hypot(...s.point.map((c, k) => c - p.point[k])) < radius / 3)) stroke.push({ at: [x, y], point: p.point, normal: p.normal });
  }
  decorate();
}

const brushRadius = () => Math.min(Math.max(Number($("radius").value) || 15, 2), 200) / 1e3;

function released(e) {
  const [x, y] = place(e), still = down && Math.hypot(x - down[0], y - down[1]) < 5;
  if (state.tool === "spot" && still) { const p = pick(x, y); if (p) add({ kind: "spot", point_m: p.point }); }
  else if (state.tool === "line" && still) {
    const p = pick(x, y);
    if (p) (stroke ??= []).push({ at: [x, y], point: p.point });
    if (stroke?.length === 2) { const points_m = stroke.map((s) => s.point); stroke = null; add({ kind: "line", points_m }); }
  } else if (stroke && state.tool === "lasso") {
    const step = Math.max(1, Math.ceil(stroke.length / 150)), kept = stroke.filter((_, k) => k % step === 0), toward = stroke[0].toward;
    stroke = null;
    if (kept.length > 2) add({ kind: "lasso", outline_m: kept.map((s) => s.point), toward_viewer: toward });
  } else if (stroke && state.tool === "brush") {
    const s = stroke;
    stroke = null;
    if (s.length) add({ kind: "brush", points_m: s.map((q) => q.point), normals: s.map((q) => q.normal), radius_m: brushRadius() });
  }
  down = null;
  decorate();
}

/** What stands over the picture: marks of spots, a stroke being drawn, sides, ruler. */
function decorate() {
  const items = [];
  state.regions.forEach((region, k) => {
    const r = state.readings[k], p = region.point_m && region.kind === "spot" ? region.point_m : r.line ? r.line[0] : r.vertex?.length ? skin.point(r.vertex[r.vertex.length >> 1]) : null;
    if (!p) return;
    const [x, y] = body.project(p), seen = down ? true : visible(p, x, y), g = svg("g", { class: seen ? "" : "behind" });
    if (region.kind === "spot") g.append(svg("circle", { cx: x, cy: y, r: 4 }));
    g.append(svg("text", { x: x + 7, y: y - 5 }, `${k + 1}  ${told(r.value_degC, NaN)}`));
    items.push(g);
  });
  if (stroke?.length) items.push(svg("polyline", { points: stroke.map((s) => s.at.join(",")).join(" ") }));
  $("overlay").replaceChildren(...items);
  const right = body.camera.matrixWorld.elements[0];
  $("side-right").textContent = right > 0.35 ? "L" : right < -0.35 ? "R" : "";
  $("side-left").textContent = right > 0.35 ? "R" : right < -0.35 ? "L" : "";
  $("stage").classList.toggle("two", state.beside >= 0);
  $("stage").dataset.left = $("side-left").textContent;
  $("stage").dataset.right = $("side-right").textContent;
  const length = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1].find((m) => m * body.pxPerM > 60) ?? 1;
  $("ruler").querySelector("i").style.width = `${length * body.pxPerM}px`;
  $("ruler").querySelector("span").textContent = length < 0.01 ? `${length * 1e3} mm` : `${+(length * 100).toFixed(0)} cm`;
}

function visible(p, x, y) {
  if (!skin._bvh) return true;
  const hit = body.pick(x, y);
  return !hit || Math.hypot(...hit.point.map((c, k) => c - p[k])) < 0.012;
}

// ------------------------------------------------------------ files, keys, print

function save(name, data, type) {
  const a = make("a", { download: name, href: URL.createObjectURL(data instanceof Blob ? data : new Blob([data], { type })) });
  a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 10000);
}

/** The screen as a picture, with title, colours and who it is. */
async function picture() {
  body.render();
  const c = $("body"), l = $("legend"), pad = 70, out = make("canvas", { width: c.width, height: c.height + pad + 60 }), g = out.getContext("2d");
  g.fillStyle = "#fff"; g.fillRect(0, 0, out.width, out.height);
  g.drawImage(c, 0, pad);
  g.fillStyle = "#111"; g.font = "20px sans-serif";
  g.fillText([state.map, ...(state.beside >= 0 ? [state.beside] : [])].map(title).join("  |  "), 16, 28);
  g.font = "14px sans-serif";
  g.fillText(`${facts.scan} · ${facts.level} · thermofusion ${facts.software.split(" ").at(-1)} · research use, not a diagnosis`.slice(0, 160), 16, 52);
  if (!l.hidden) g.drawImage(l, 16, out.height - 58, Math.min(520, out.width - 32), 52);
  g.fillText($("side-left").textContent, 16, out.height - 70); g.fillText($("side-right").textContent, out.width - 30, out.height - 70);
  return new Promise((done) => out.toBlob(done, "image/png"));
}

function shots() {
  $("shots")?.remove();
  const box = make("div", { id: "shots" }), ratio = body.extent[1] > body.extent[0] ? 0.62 : 1;
  for (const name of ["front", "back", "left", "right"]) {
    const side = { front: "the person's right is on the left of the picture", back: "the person's left is on the left of the picture" }[name];
    const img = make("img", { src: body.picture(name, Math.round(760 * ratio), 760), alt: `${title(state.map)}, ${name}` });
    box.append(make("figure", {}, make("figcaption", {}, `${name}${side ? `: ${side}` : " side of the person"}`), img));
  }
  const caption = make("figcaption", {}, `${title(state.map)}, from ${$("low").value} to ${$("high").value}`);
  box.append(make("figure", {}, caption, make("img", { class: "scale", src: $("legend").toDataURL(), alt: "" })));
  $("screen").append(box);
  document.body.classList.add("shot");
}

function listen() {
  const on = (id, event, act) => $(id).addEventListener(event, act);
  on("map", "change", (e) => choose(Number(e.target.value)));
  on("beside", "change", (e) => beside(Number(e.target.value)));
  on("palette", "change", (e) => { const m = facts.maps[state.map]; state.palettes[state.map] = e.target.value; if (m.level) facts.maps.forEach((x, k) => { if (x.level) state.palettes[k] = e.target.value; }); $("fault").textContent = facts.warnings[e.target.value] ?? ""; shown(); });
  for (const id of ["low", "high"]) on(id, "change", () => range(Number($("low").value), Number($("high").value)));
  on("auto", "click", () => range(...facts.maps[state.map].range));
  const uniform = (id, name, read) => on(id, "change", (e) => { body.uniforms[name].value = read(e.target); body.draw(); });
  uniform("isotherms", "step_", (t) => Math.max(Number(t.value) || 0, 0));
  uniform("beyond", "beyond", (t) => Number(t.checked));
  uniform("flagged", "flagged", (t) => Number(t.checked));
  uniform("shaded", "shade", (t) => (t.checked ? 0.45 : 0));
  const cut = () => body.cut($("cut").value || null, Number($("cut-share").value) / 100);
  on("cut", "change", cut);
  on("cut-share", "input", cut);
  on("cameras", "change", (e) => { body.cameras.visible = e.target.checked; body.draw(); });
  for (const b of document.querySelectorAll("[data-view]")) b.addEventListener("click", () => body.view(b.dataset.view));
  for (const b of document.querySelectorAll("[data-tool]")) b.addEventListener("click", () => tool(b.dataset.tool));
  const c = $("body");
  c.addEventListener("pointermove", (e) => { pointer = place(e); if (stroke && down && state.tool !== "line") drawn(pointer); if (!hover.waiting && !e.buttons) { hover.waiting = true; requestAnimationFrame(hover); } });
  c.addEventListener("pointerleave", () => { pointer = null; $("readout").textContent = ""; });
  c.addEventListener("pointerdown", pressed);
  c.addEventListener("pointerup", released);
  c.addEventListener("webglcontextlost", (e) => { e.preventDefault(); $("stage").hidden = true; $("pictures").classList.remove("drawn"); $("fault").textContent = "The graphics were lost; the pictures stand in for them."; });
  c.addEventListener("webglcontextrestored", () => { $("stage").hidden = false; $("pictures").classList.add("drawn"); $("fault").textContent = ""; body.draw(); });
  new ResizeObserver(() => { body.resize(); shown(); }).observe($("stage"));
  on("csv", "click", () => save("regions.csv", table(), "text/csv"));
  on("save", "click", () => save("regions.json", JSON.stringify(document_(), null, 1), "application/json"));
  on("load", "change", async (e) => { if (e.target.files[0]) await loaded(e.target.files[0]); e.target.value = ""; });
  on("picture", "click", async () => save("report.png", await picture(), "image/png"));
  on("print", "click", () => window.print());
  on("help", "click", () => { $("keys").hidden = !$("keys").hidden; $("help").setAttribute("aria-expanded", String(!$("keys").hidden)); });
  window.addEventListener("beforeprint", shots);
  document.addEventListener("keydown", key);
  listed();
}

function key(e) {
  if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches?.("select, input:not([type=checkbox])")) return;
  const views = { 1: "front", 2: "back", 3: "left", 4: "right", 5: "soles" }, tools = { t: "turn", s: "spot", l: "line", r: "lasso", b: "brush", Escape: "turn" };
  const turns = { ArrowLeft: [-0.2, 0], ArrowRight: [0.2, 0], ArrowUp: [0, -0.2], ArrowDown: [0, 0.2] };
  const c = $("body"), middle = () => pointer ?? [c.clientWidth / 2, c.clientHeight / 2];
  if (views[e.key]) body.view(views[e.key]);
  else if (tools[e.key]) tool(tools[e.key]);
  else if (turns[e.key] && e.target === c) body.turn(...turns[e.key]);
  else if (e.key === "+" || e.key === "=") body.zoom(1.2);
  else if (e.key === "-") body.zoom(1 / 1.2);
  else if (e.key === "h") $("say").textContent = $("readout").textContent = words(pick(...middle())) || "no skin there";
  else if (e.key === "Enter" && e.target === c && state.tool === "spot") { const p = pick(...middle()); if (p) add({ kind: "spot", point_m: p.point }); }
  else return;
  e.preventDefault();
}

function frusta() {
  return facts.cameras.flatMap((T) => {
    const at = (x, y, z) => [0, 1, 2].map((r) => T[4 * r] * x + T[4 * r + 1] * y + T[4 * r + 2] * z + T[4 * r + 3]);
    const o = at(0, 0, 0), corners = [[-0.02, -0.015], [0.02, -0.015], [0.02, 0.015], [-0.02, 0.015]].map(([x, y]) => at(x, y, 0.04));
    return corners.flatMap((p, k) => [o, p, p, corners[(k + 1) % 4]]);
  });
}

function make(tag, attributes = {}, ...content) {
  const e = document.createElement(tag);
  for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
  e.append(...content);
  return e;
}

function svg(tag, attributes, text) {
  const e = document.createElementNS(NS, tag);
  for (const [k, v] of Object.entries(attributes)) e.setAttribute(k, v);
  if (text) e.textContent = text;
  return e;
}
