// The skin as a graph and as triangles: nearest points, what hides what, ways over it. Follows regions/body.py.

import { BufferAttribute, BufferGeometry, FrontSide, DoubleSide, Ray, Vector3 } from "three";
import { MeshBVH } from "three-mesh-bvh";

const SKIN_OFFSET_M = 2e-3, STEP_M = 2e-3, RELAXATIONS = 30;

export class Surface {
  /** vertices: Float32Array of x y z, upright; triangles: Int32Array of corners, counter-clockwise from outside. */
  constructor(vertices, triangles) {
    this.vertices = vertices;
    this.triangles = triangles;
    this.count = vertices.length / 3;
    this.geometry = new BufferGeometry();
    this.geometry.setAttribute("position", new BufferAttribute(vertices, 3));
    this.geometry.setIndex(new BufferAttribute(new Uint32Array(triangles), 1));
    this.normals = this.#normals();
  }

  get bvh() {
    return (this._bvh ??= new MeshBVH(this.geometry, { indirect: true, targetLeafSize: 8 }));
  }

  #normals() {
    const { vertices: v, triangles: t } = this, n = new Float32Array(v.length);
    for (let k = 0; k < t.length; k += 3) {
      const a = 3 * t[k], b = 3 * t[k + 1], c = 3 * t[k + 2];
      const ux = v[b] - v[a], uy = v[b + 1] - v[a + 1], uz = v[b + 2] - v[a + 2];
      const wx = v[c] - v[a], wy = v[c + 1] - v[a + 1], wz = v[c + 2] - v[a + 2];
      const x = uy * wz - uz * wy, y = uz * wx - ux * wz, z = ux * wy - uy * wx;
      for (const i of [a, b, c]) { n[i] += x; n[i + 1] += y; n[i + 2] += z; }
    }
    for (let i = 0; i < n.length; i += 3) {
      const length = Math.hypot(n[i], n[i + 1], n[i + 2]) || 1;
      n[i] /= length; n[i + 1] /= length; n[i + 2] /= length;
    }
    return n;
  }

  point(i) { return [this.vertices[3 * i], this.vertices[3 * i + 1], this.vertices[3 * i + 2]]; }
  normal(i) { return [this.normals[3 * i], this.normals[3 * i + 1], this.normals[3 * i + 2]]; }

  /** The first skin on a ray that is `shown` (a predicate on points), or null: its point, triangle, corners, barycentric weights (in double precision). */
  hit(origin, direction, shown = () => true) {
    const ray = new Ray(new Vector3(...origin), new Vector3(...direction));
    let found = this.bvh.raycastFirst(ray, DoubleSide);
    if (found && !shown(found.point))
      found = this.bvh.raycast(ray, DoubleSide).filter((f) => shown(f.point)).sort((f, g) => f.distance - g.distance)[0];
    return found ? this.#place(found.point.toArray(), found.faceIndex) : null;
  }

  /** The skin nearest to a point. */
  nearest(p) {
    const found = this.bvh.closestPointToPoint(new Vector3(...p));
    return this.#place(found.point.toArray(), found.faceIndex);
  }

  #place(p, triangle) {
    const corners = [...this.triangles.subarray(3 * triangle, 3 * triangle + 3)];
    const [a, b, c] = corners.map((i) => this.point(i));
    const u = sub(b, a), w = sub(c, a), q = sub(p, a);
    const uu = dot(u, u), uw = dot(u, w), ww = dot(w, w), qu = dot(q, u), qw = dot(q, w);
    const det = uu * ww - uw * uw || 1e-30;
    const s = (ww * qu - uw * qw) / det, t = (uu * qw - uw * qu) / det;
    return { point: p, triangle, corners, weights: [1 - s - t, s, t] };
  }

  /** Whether skin stands between a vertex and an eye far away in a direction. */
  hidden(i, toward) {
    const p = this.point(i), n = this.normal(i);
    const origin = new Vector3(p[0] + SKIN_OFFSET_M * n[0], p[1] + SKIN_OFFSET_M * n[1], p[2] + SKIN_OFFSET_M * n[2]);
    return this.bvh.raycastFirst(new Ray(origin, new Vector3(...toward)), DoubleSide) !== null;
  }

  /** Edges as neighbours in one array: starts[i]..starts[i+1] of ends and lengths; across each edge, too. */
  get graph() {
    return (this._graph ??= this.#graph());
  }

  #graph() {
    const { triangles: t, count: n } = this, sides = t.length;
    const key = new Float64Array(sides);
    for (let k = 0; k < sides; k++) {
      const a = t[k], b = t[k % 3 === 2 ? k - 2 : k + 1];
      key[k] = (Math.min(a, b) * n + Math.max(a, b)) * 1; // below 2^53 for 90 million vertices
    }
    const order = Uint32Array.from({ length: sides }, (_, k) => k);
    order.sort((i, j) => key[i] - key[j]);
    const from = [], to = [], length = [];
    const join = (a, b, d) => { from.push(a, b); to.push(b, a); length.push(d, d); };
    const far = (k) => t[k - (k % 3) + ((k + 2) % 3)];
    for (let r = 0; r < sides; r++) {
      const k = order[r], again = r > 0 && key[order[r - 1]] === key[k];
      const a = t[k], b = t[k % 3 === 2 ? k - 2 : k + 1];
      if (!again) join(a, b, distance(this.point(a), this.point(b)));
      else {
        const c = far(k), d = far(order[r - 1]);
        const over = unfolded(this.point(a), this.point(b), this.point(c), this.point(d));
        if (over > 0) join(c, d, over);
      }
    }
    const starts = new Uint32Array(n + 1);
    for (const a of from) starts[a + 1]++;
    for (let i = 0; i < n; i++) starts[i + 1] += starts[i];
    const at = starts.slice(), ends = new Uint32Array(from.length), lengths = new Float32Array(from.length);
    for (let e = 0; e < from.length; e++) { ends[at[from[e]]] = to[e]; lengths[at[from[e]]++] = length[e]; }
    return { starts, ends, lengths };
  }

  /** What of `inside` (a predicate) hangs together with any of the seeds: a Uint8Array over vertices. */
  together(inside, seeds) {
    const kept = new Uint8Array(this.count), { starts, ends } = this.neighbours;
    const stack = seeds.filter(inside);
    for (const s of stack) kept[s] = 1;
    while (stack.length) {
      const i = stack.pop();
      for (let e = starts[i]; e < starts[i + 1]; e++) {
        const j = ends[e];
        if (!kept[j] && inside(j)) { kept[j] = 1; stack.push(j); }
      }
    }
    return kept;
  }

  /** Corners that share a triangle: quick to make, for `together`. */
  get neighbours() {
    if (this._neighbours) return this._neighbours;
    const { triangles: t, count: n } = this, starts = new Uint32Array(n + 1);
    for (let k = 0; k < t.length; k++) starts[t[k] + 1] += 2;
    for (let i = 0; i < n; i++) starts[i + 1] += starts[i];
    const at = starts.slice(), ends = new Uint32Array(2 * t.length);
    for (let k = 0; k < t.length; k += 3)
      for (let c = 0; c < 3; c++) {
        ends[at[t[k + c]]++] = t[k + ((c + 1) % 3)];
        ends[at[t[k + c]]++] = t[k + ((c + 2) % 3)];
      }
    return (this._neighbours = { starts, ends });
  }

  nearestVertex(p) {
    let best = 0, least = Infinity;
    const v = this.vertices;
    for (let i = 0, k = 0; k < v.length; i++, k += 3) {
      const d = (v[k] - p[0]) ** 2 + (v[k + 1] - p[1]) ** 2 + (v[k + 2] - p[2]) ** 2;
      if (d < least) { least = d; best = i; }
    }
    return best;
  }

  /** The shortest line over the surface: Dijkstra, then drawn taut, coarse first. Null: no skin joins the two. */
  path(start, end) {
    const p = this.nearest(start), q = this.nearest(end);
    const heaviest = (x) => x.corners[x.weights.indexOf(Math.max(...x.weights))];
    const a = heaviest(p), b = heaviest(q);
    if (a === b) return [p.point, q.point];
    const chain = this.#dijkstra(a, b);
    if (!chain) return null;
    let line = resampled([p.point, ...chain.slice(1, -1).map((i) => this.point(i)), q.point], 9);
    for (;;) {
      for (let r = 0; r < RELAXATIONS; r++) {
        const middle = line.slice(1, -1).map((_, k) => this.nearest(mean(line[k], line[k + 2])).point);
        line = [line[0], ...middle, line.at(-1)];
      }
      if (along(line).at(-1) <= STEP_M * (line.length - 1)) return line;
      line = line.flatMap((x, k) => (k ? [this.nearest(mean(line[k - 1], x)).point, x] : [x]));
    }
  }

  #dijkstra(a, b) {
    const { starts, ends, lengths } = this.graph;
    const way = new Float64Array(this.count).fill(Infinity), before = new Int32Array(this.count).fill(-1);
    const heap = [[0, a]];
    way[a] = 0;
    while (heap.length) {
      const [d, i] = pop(heap);
      if (i === b) break;
      if (d > way[i]) continue;
      for (let e = starts[i]; e < starts[i + 1]; e++) {
        const j = ends[e], w = d + lengths[e];
        if (w < way[j]) { way[j] = w; before[j] = i; push(heap, [w, j]); }
      }
    }
    if (!isFinite(way[b])) return null;
    const chain = [b];
    while (chain.at(-1) !== a) chain.push(before[chain.at(-1)]);
    return chain.reverse();
  }
}

/** Lengths from the start along a polyline. */
export function along(line) {
  const s = [0];
  for (let k = 1; k < line.length; k++) s.push(s[k - 1] + distance(line[k - 1], line[k]));
  return s;
}

/** Points at even steps along a polyline. */
export function resampled(line, count) {
  const s = along(line), out = [];
  for (let r = 0, k = 0; r < count; r++) {
    const at = (s.at(-1) * r) / (count - 1);
    while (k < s.length - 2 && s[k + 1] < at) k++;
    const f = s[k + 1] > s[k] ? (at - s[k]) / (s[k + 1] - s[k]) : 0;
    out.push(line[k].map((x, d) => x + Math.min(f, 1) * (line[k + 1][d] - x)));
  }
  return out;
}

function unfolded(a, b, c, d) {
  const width = distance(a, b);
  if (!width) return 0;
  const u = sub(b, a).map((x) => x / width), ac = sub(c, a), ad = sub(d, a);
  const xc = dot(ac, u), xd = dot(ad, u);
  const yc = Math.hypot(...ac.map((x, k) => x - xc * u[k])), yd = Math.hypot(...ad.map((x, k) => x - xd * u[k]));
  const crossing = (xc * yd + xd * yc) / (yc + yd);
  return crossing >= 0 && crossing <= width ? Math.hypot(xc - xd, yc + yd) : 0;
}

export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => { const l = Math.hypot(...a) || 1e-12; return a.map((x) => x / l); };
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
const mean = (a, b) => a.map((x, k) => (x + b[k]) / 2);

function push(heap, item) {
  let i = heap.push(item) - 1;
  while (i && heap[(i - 1) >> 1][0] > item[0]) { heap[i] = heap[(i - 1) >> 1]; i = (i - 1) >> 1; }
  heap[i] = item;
}

function pop(heap) {
  const top = heap[0], last = heap.pop();
  if (heap.length) {
    let i = 0;
    for (;;) {
      let c = 2 * i + 1;
      if (c >= heap.length) break;
      if (c + 1 < heap.length && heap[c + 1][0] < heap[c][0]) c++;
      if (heap[c][0] >= last[0]) break;
      heap[i] = heap[c];
      i = c;
    }
    heap[i] = last;
  }
  return top;
}
