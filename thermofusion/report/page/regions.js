// What regions read. Follows thermofusion/regions/ (patch.py, errors.py, measure.py), which defines it.

import { along, cross, dot, resampled, sub, unit } from "./surface.js";

const NOT_SKIN = 64; // of the flags: left out of means, as in Python
const MIN_FACING = 0.2, MARGIN_M = 0.02, PROFILE_STEP_M = 2e-3;

/** A region's signed distance at every vertex: negative inside, NaN where it cannot reach. */
export function borderOf(region, skin) {
  return { brush: withinStroke, lasso: withinOutline, slab: betweenPlanes }[region.kind](region, skin);
}

function withinStroke({ points_m, normals, radius_m }, skin) {
  const border = new Float64Array(skin.count).fill(NaN), v = skin.vertices, n = skin.normals, reach = radius_m + MARGIN_M;
  points_m.forEach((p, s) => {
    const q = unit(normals[s]);
    for (let i = 0, k = 0; i < skin.count; i++, k += 3) {
      const x = v[k] - p[0], y = v[k + 1] - p[1], z = v[k + 2] - p[2];
      if (Math.abs(x) > reach || Math.abs(y) > reach || Math.abs(z) > reach) continue;
      if (n[k] * q[0] + n[k + 1] * q[1] + n[k + 2] * q[2] <= MIN_FACING) continue;
      const d = Math.hypot(x, y, z) - radius_m;
      if (d < MARGIN_M && !(border[i] <= d)) border[i] = d;
    }
  });
  return joined(skin, border, points_m.map((p) => skin.nearestVertex(p)));
}

function joined(skin, border, seeds) {
  const kept = skin.together((i) => border[i] < 0, seeds);
  for (let i = 0; i < border.length; i++) if (border[i] < 0 && !kept[i]) border[i] = NaN;
  return border;
}

function withinOutline({ outline_m, toward_viewer }, skin) {
  const toward = unit(toward_viewer);
  const x = unit(cross(Math.abs(toward[1]) < 0.9 ? [0, 1, 0] : [0, 0, 1], toward)), y = cross(toward, x);
  const outline = outline_m.map((p) => [dot(p, x), dot(p, y)]);
  const bound = (k, f) => f(...outline.map((p) => p[k]));
  const [x0, x1] = [bound(0, Math.min) - MARGIN_M, bound(0, Math.max) + MARGIN_M];
  const [y0, y1] = [bound(1, Math.min) - MARGIN_M, bound(1, Math.max) + MARGIN_M];
  const border = new Float64Array(skin.count).fill(NaN);
  for (let i = 0; i < skin.count; i++) {
    const p = skin.point(i), u = dot(p, x), w = dot(p, y);
    if (u <= x0 || u >= x1 || w <= y0 || w >= y1 || dot(skin.normal(i), toward) <= 0) continue;
    if (!skin.hidden(i, toward)) border[i] = polygonDistance(u, w, outline);
  }
  return border;
}

function polygonDistance(x, y, outline) {
  let best = Infinity, inside = false;
  for (let k = 0; k < outline.length; k++) {
    const a = outline[k], b = outline[(k + 1) % outline.length], dx = b[0] - a[0], dy = b[1] - a[1];
    const t = Math.min(Math.max(((x - a[0]) * dx + (y - a[1]) * dy) / Math.max(dx * dx + dy * dy, 1e-18), 0), 1);
    best = Math.min(best, Math.hypot(x - a[0] - t * dx, y - a[1] - t * dy));
    if (a[1] > y !== b[1] > y && x < a[0] + ((y - a[1]) * dx) / dy) inside = !inside;
  }
  return inside ? -best : best;
}

function betweenPlanes({ point_m, axis, length_m }, skin) {
  const u = unit(axis), border = new Float64Array(skin.count);
  for (let i = 0; i < skin.count; i++) {
    const s = dot(sub(skin.point(i), point_m), u);
    border[i] = Math.max(-s, s - length_m);
  }
  return joined(skin, border, [skin.nearestVertex(point_m.map((x, k) => x + (u[k] * length_m) / 2))]);
}

/** The skin where the border is negative: vertices with weights, areas in m², and the border as line segments. */
export function patchOf(region, skin, measured) {
  const border = borderOf(region, skin), t = skin.triangles;
  const weight = new Map(), segments = [];
  let area = 0, known = 0;
  const add = (corners, share, centre) => {
    const [a, b, c] = corners.map((i) => skin.point(i));
    const size = (share * Math.hypot(...cross(sub(b, a), sub(c, a)))) / 2;
    area += size;
    if (!corners.every((i) => measured(i))) return;
    known += size;
    corners.forEach((i, k) => weight.set(i, (weight.get(i) ?? 0) + size * centre[k]));
  };
  for (let k = 0; k < t.length; k += 3) {
    const f = [border[t[k]], border[t[k + 1]], border[t[k + 2]]];
    const inside = f.map((x) => x < 0), n = inside[0] + inside[1] + inside[2];
    if (!n || f.some(Number.isNaN)) continue;
    if (n === 3) { add([t[k], t[k + 1], t[k + 2]], 1, [1 / 3, 1 / 3, 1 / 3]); continue; }
    const lone = n === 1 ? inside.indexOf(true) : inside.indexOf(false);
    const [i, j, l] = [0, 1, 2].map((c) => (lone + c) % 3), corners = [t[k + i], t[k + j], t[k + l]];
    const s = f[i] / (f[i] - f[j]), w = f[i] / (f[i] - f[l]);
    let share = s * w, centre = [(3 - s - w) / 3, s / 3, w / 3];
    if (n === 2) {
      const left = Math.max(1 - share, 1e-12);
      centre = centre.map((c) => (1 / 3 - share * c) / left);
      share = 1 - share;
    }
    add(corners, share, centre);
    const [a, b, c] = corners.map((q) => skin.point(q));
    segments.push(a.map((x, d) => x + s * (b[d] - x)), a.map((x, d) => x + w * (c[d] - x)));
  }
  const vertex = [...weight.keys()];
  return { vertex, weight: vertex.map((i) => weight.get(i)), inside: vertex.map((i) => border[i] < 0), area, known, segments };
}

export class Measurer {
  /** columns: as packed; facts.errors: what the columns of common effects are. */
  constructor(skin, columns, facts) {
    Object.assign(this, { skin, columns, facts, T: columns.temperature, errors: facts.errors });
  }

  read(region) {
    return { name: region.name ?? "", kind: region.kind, ...{ spot: this.#spot, line: this.#line }[region.kind]?.call(this, region) ?? this.#area(region) };
  }

  #spot({ point_m }) {
    const { corners, weights } = this.skin.nearest(point_m);
    const value = corners.reduce((sum, i, k) => sum + weights[k] * this.T[i], 0);
    return this.#told(value, this.errorsOf(corners, weights, 0), { n: 1, at: [point_m] });
  }

  #area(region) {
    const patch = patchOf(region, this.skin, (i) => !Number.isNaN(this.T[i]) && !(this.columns.flags[i] & NOT_SKIN));
    const size = { area_cm2: patch.area * 1e4, segments: patch.segments, n: 0, vertex: patch.vertex };
    if (!patch.vertex.length) return { value_degC: NaN, sigma_K: NaN, ...size };
    const { vertex, weight, inside, known } = patch, T = vertex.map((i) => this.T[i]);
    const mean = sum(weight, T) / known, any = inside.some(Boolean), chosen = T.map((_, k) => inside[k] === any);
    let w = 0, w2 = 0, low = Infinity, high = -Infinity, n = 0;
    T.forEach((x, k) => {
      if (!chosen[k]) return;
      w += weight[k]; w2 += weight[k] * (x - mean) ** 2; n += inside[k];
      low = Math.min(low, x); high = Math.max(high, x);
    });
    const found = { sd_K: Math.sqrt(w2 / w), min_degC: low, max_degC: high, n, measured_fraction: known / patch.area };
    return this.#told(mean, this.errorsOf(vertex, weight, known), { ...size, ...found });
  }

  #line({ points_m }) {
    const pieces = points_m.slice(1).map((p, k) => this.skin.path(points_m[k], p));
    if (pieces.some((p) => !p)) return { value_degC: NaN, sigma_K: NaN, n: 0 };
    const line = pieces.flat(), length = along(line).at(-1), count = Math.max(Math.ceil(length / PROFILE_STEP_M), 1) + 1;
    const vertex = [], weight = [], profile = { mm: [], degC: [], sigma_K: [] };
    resampled(line, count).forEach((p, r) => {
      const { corners, weights } = this.skin.nearest(p);
      const at = (column) => corners.reduce((s, i, k) => s + weights[k] * column[i], 0), T = at(this.T);
      profile.mm.push((1e3 * length * r) / (count - 1));
      profile.degC.push(T);
      profile.sigma_K.push(at(this.columns.sigma));
      if (!Number.isNaN(T)) { vertex.push(...corners); weight.push(...weights); }
    });
    const known = profile.degC.filter((x) => !Number.isNaN(x)), size = { length_mm: 1e3 * length, profile, line, n: known.length };
    if (!known.length) return { value_degC: NaN, sigma_K: NaN, ...size };
    const mean = known.reduce((a, b) => a + b, 0) / known.length;
    const found = { sd_K: Math.sqrt(known.reduce((s, x) => s + (x - mean) ** 2, 0) / known.length), min_degC: Math.min(...known), max_degC: Math.max(...known), measured_fraction: known.length / count };
    return this.#told(mean, this.errorsOf(vertex, weight, length, true), { ...size, ...found });
  }

  #told(value, errors, rest) {
    const known = !Number.isNaN(value);
    return {
      value_degC: value,
      sigma_K: known ? Math.sqrt(errors.own + norm2(errors.common)) : NaN,
      sigma_absolute_K: known && this.facts.anchored ? Math.sqrt(errors.own + norm2(errors.absolute)) : NaN,
      errors,
      ...rest,
    };
  }

  /** The errors of a weighted mean; extent: its area, m², or along a line its length, m. */
  errorsOf(vertex, weight, extent, line = false) {
    const total = weight.reduce((a, b) => a + b, 0), size = Math.max(extent, 1e-12);
    const mean = (f) => vertex.reduce((s, i, k) => s + weight[k] * f(i), 0) / total;
    const { noise, noise_width, normals, rest, askew, common } = this.columns, { steps, levels, window_m, askew_step } = this.errors;
    const v = this.skin.count, w = (x) => (Number.isNaN(x) ? 0 : x);
    const wide = mean((i) => w(noise[i] ** 2 * noise_width[i] ** (line ? 1 : 2)));
    const noise2 = Math.min(mean((i) => w(noise[i] ** 2)), wide / size);
    const share = Math.min(1, (line ? window_m : (Math.PI / 4) * window_m ** 2) / size);
    const slanted = [0, 1, 2].map((k) => askew_step[k] * mean((i) => askew[k * v + i]));
    const absolute = steps.map((step, r) => step * mean((i) => common[r * v + i]));
    const own = noise2 + share * mean((i) => w(normals[i] ** 2)) + norm2(slanted) + mean((i) => w(rest[i])) ** 2;
    return { own, absolute, common: absolute.map((x, r) => x - levels[r]) };
  }

  /** Left less right of regions named alike, every other spot less the next. */
  differences(regions, readings) {
    const sides = new Map(), pairs = [];
    regions.forEach((r, k) => { const o = opposite(r.name); if (o) sides.set(o.join(" "), k); });
    for (const [key, k] of sides) {
      const other = key.startsWith("left ") && sides.get("right " + key.slice(5));
      if (typeof other === "number") pairs.push([k, other]);
    }
    const spots = regions.flatMap((r, k) => (r.kind === "spot" && !opposite(r.name) ? [k] : []));
    for (let k = 1; k < spots.length; k++) pairs.push([spots[k - 1], spots[k]]);
    return pairs.map(([i, j]) => {
      const a = readings[i], b = readings[j], spot = regions[i].kind === "spot" && regions[j].kind === "spot";
      const line = spot ? this.skin.path(regions[i].point_m, regions[j].point_m) : null;
      const sigma = a.errors && b.errors ? Math.sqrt(a.errors.own + b.errors.own + norm2(a.errors.common.map((x, r) => x - b.errors.common[r]))) : NaN;
      return { first: a.name, second: b.name, delta_K: a.value_degC - b.value_degC, sigma_K: sigma, distance_mm: line ? 1e3 * along(line).at(-1) : NaN };
    });
  }
}

/** ["left" or "right", what] of a name that begins or ends with a side. */
export function opposite(name) {
  const words = (name ?? "").replace(/[,_]/g, " ").split(/\s+/).filter(Boolean), low = words.map((w) => w.toLowerCase());
  for (const side of ["left", "right"]) {
    if (words.length < 2) continue;
    if (low[0] === side) return [side, low.slice(1).join(" ")];
    if (low.at(-1) === side) return [side, low.slice(0, -1).join(" ")];
  }
  return null;
}

const sum = (w, x) => w.reduce((s, y, k) => s + y * x[k], 0);
const norm2 = (x) => x.reduce((s, y) => s + y * y, 0);
