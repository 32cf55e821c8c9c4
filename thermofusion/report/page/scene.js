// The body in three dimensions: colours mean temperature, light never changes them unless asked to.

import {
  BackSide, BufferAttribute, BufferGeometry, DataTexture, DoubleSide, GLSL3, LinearSRGBColorSpace, LineBasicMaterial,
  LineSegments, Mesh, NearestFilter, OrthographicCamera, RGBAFormat, Scene, ShaderMaterial, Vector3, Vector4, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const OUTLINE_PX = 1.3;
export const VIEWS = { front: [0, 0, 1], back: [0, 0, -1], left: [1, 0, 0], right: [-1, 0, 0], soles: [0, -1, 0] };

const VERTEX = `
in float value; in vec2 mark; in vec3 skin;
out float vValue; out vec2 vMark; out vec3 vSkin; out vec3 vNormal; out vec3 vPlace;
void main() {
  vValue = value; vMark = mark; vSkin = skin; vNormal = normal; vPlace = position;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

// Grey stripes: skin without a value, and the surface seen from inside, as in the PNG views.
const FRAGMENT = `
precision highp float;
uniform sampler2D palette; uniform float lo, hi, middle, step_, shade, px; uniform int kind, beyond, flagged; uniform vec3 eye; uniform vec4 cut;
in float vValue; in vec2 vMark; in vec3 vSkin; in vec3 vNormal; in vec3 vPlace;
out vec4 color;
bool stripe(float period, float sign_, float width) {
  return mod(gl_FragCoord.x + sign_ * gl_FragCoord.y, period * px) < width * px;
}
void main() {
  vec3 c;
  if (dot(vPlace, cut.xyz) > cut.w) discard;
  if (!gl_FrontFacing) c = stripe(8.0, -1.0, 4.0) ? vec3(0.33) : vec3(0.44);
  else if (kind == 1) c = vSkin;
  else if (vMark.x < 0.999) c = stripe(8.0, 1.0, 4.0) ? vec3(0.745) : vec3(0.886);
  else {
    float v = vValue + middle, t = clamp((v - lo) / (hi - lo), 0.0, 1.0);
    c = texture(palette, vec2((floor(t * 255.0 + 0.5) + 0.5) / 256.0, 0.5)).rgb;
    if (beyond == 1 && v < lo) c = vec3(0.0, 0.62, 0.71);
    if (beyond == 1 && v > hi) c = vec3(0.91, 0.0, 0.54);
    if (step_ > 0.0) {
      float s = v / step_, d = abs(fract(s - 0.5) - 0.5) / max(fwidth(s), 1e-6);
      if (d < 0.6 * px) c = mix(c, t > 0.5 ? vec3(0.0) : vec3(1.0), 0.75);
    }
    if (flagged == 1 && vMark.y > 0.5 && stripe(9.0, 1.0, 1.2)) c = mix(c, vec3(0.5), 0.8);
  }
  if (shade > 0.0) c *= 1.0 - shade * (1.0 - abs(dot(normalize(vNormal), eye)));
  color = vec4(c, 1.0);
}`;

const HULL = `
uniform vec2 size; uniform float px;
out vec3 vPlace;
void main() {
  vPlace = position;
  vec4 p = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  vec2 n = (projectionMatrix * modelViewMatrix * vec4(normal, 0.0)).xy * size;
  p.xy += normalize(n + 1e-9) * ${OUTLINE_PX.toFixed(1)} * px * 2.0 / size;
  p.z += 2.5e-3; // about a centimetre behind: folds of the skin itself draw no line
  gl_Position = p;
}`;

export class Body3D {
  /** skin: a Surface; columns: as packed; rgb: of the colour camera, or null. */
  constructor(canvas, skin, columns) {
    this.skin = skin;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = LinearSRGBColorSpace; // bytes of the palette go to the screen as they are
    this.renderer.autoClear = false;
    this.scene = new Scene();
    this.camera = new OrthographicCamera(-1, 1, 1, -1, 0.01, 100);
    const g = skin.geometry, n = skin.count, mark = new Float32Array(2 * n);
    for (let i = 0; i < n; i++) mark[2 * i + 1] = columns.flags[i] & ~1 ? 1 : 0;
    g.setAttribute("normal", new BufferAttribute(skin.normals, 3));
    g.setAttribute("skin", new BufferAttribute(colors(columns, n), 3, true));
    g.setAttribute("mark", new BufferAttribute(mark, 2));
    this.uniforms = {
      palette: { value: null }, lo: { value: 0 }, hi: { value: 1 }, middle: { value: 0 }, step_: { value: 0 }, shade: { value: 0 },
      px: { value: 1 }, kind: { value: 0 }, beyond: { value: 0 }, flagged: { value: 0 }, eye: { value: new Vector3(0, 0, 1) },
      cut: { value: new Vector4(0, 0, 0, 1) },
    };
    const material = new ShaderMaterial({ glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms, side: DoubleSide });
    this.size = { value: [1, 1] };
    const hull = new ShaderMaterial({
      glslVersion: GLSL3, vertexShader: HULL, side: BackSide, uniforms: { size: this.size, px: this.uniforms.px, cut: this.uniforms.cut },
      fragmentShader: "uniform vec4 cut; in vec3 vPlace; out vec4 color; void main() { if (dot(vPlace, cut.xyz) > cut.w) discard; color = vec4(0.16, 0.16, 0.17, 1.0); }",
    });
    this.scene.add(new Mesh(g, hull), new Mesh(g, material));
    this.scene.children.forEach((m) => (m.frustumCulled = false));
    this.marks = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: 0xffffff, depthTest: true, transparent: true }));
    this.cameras = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: 0x2f7fd0 }));
    this.cameras.visible = false;
    this.scene.add(this.marks, this.cameras);
    this.layers = []; // one or two {values, palette, lo, hi, kind}
    this.attributes = new Map();
    this.#frame();
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.onDraw = () => {};
    this.view("front");
  }

  #frame() {
    const v = this.skin.vertices, lo = [Infinity, Infinity, Infinity], hi = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < v.length; i++) { lo[i % 3] = Math.min(lo[i % 3], v[i]); hi[i % 3] = Math.max(hi[i % 3], v[i]); }
    this.centre = lo.map((x, k) => (x + hi[k]) / 2);
    this.extent = hi.map((x, k) => x - lo[k]);
    this.reach = Math.hypot(...this.extent);
  }

  /** Look from a side, the whole body in the picture. */
  view(name) {
    const d = VIEWS[name];
    this.camera.position.set(...this.centre.map((x, k) => x + d[k] * 2 * this.reach));
    this.camera.zoom = 1;
    this.controls.target.set(...this.centre);
    this.fit(name);
    this.controls.update();
    this.draw();
  }

  fit(name) {
    const side = name === "left" || name === "right";
    this.seen = [side ? this.extent[2] : this.extent[0], name === "soles" ? this.extent[2] : this.extent[1]];
    this.resize();
  }

  /** Adapt to the canvas' size: `fit`'s extent stays in the picture. */
  resize() {
    const c = this.renderer.domElement, w = c.clientWidth || 1, h = c.clientHeight || 1, panes = Math.max(this.layers.length, 1);
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(w, h, false);
    const half = 0.54 * Math.max(this.seen[1], (this.seen[0] * h) / (w / panes)), aspect = w / panes / h;
    Object.assign(this.camera, { left: -half * aspect, right: half * aspect, top: half, bottom: -half, near: 0.01 * this.reach, far: 5 * this.reach });
    this.camera.updateProjectionMatrix();
    this.size.value = [(w / panes) * ratio, h * ratio];
    this.uniforms.px.value = ratio;
  }

  /** What is shown: one map, or two side by side with one camera. */
  show(layers) {
    const panes = this.layers.length;
    this.layers = layers;
    if (panes !== layers.length) this.resize();
    this.draw();
  }

  #prepare({ values, palette, lo, hi, kind }) {
    const g = this.skin.geometry, u = this.uniforms;
    u.palette.value = texture(palette);
    u.kind.value = kind === "color" ? 1 : 0;
    if (kind !== "color") {
      let a = this.attributes.get(values);
      if (!a) {
        const known = Float32Array.from(values, (x) => (Number.isNaN(x) ? 0 : 1)), finite = values.find((x) => !Number.isNaN(x)) ?? 0;
        const mark = g.getAttribute("mark").array.slice();
        for (let i = 0; i < known.length; i++) mark[2 * i] = known[i];
        // far fewer digits are lost where values are small: the shader adds the middle again
        a = { middle: finite, value: new BufferAttribute(Float32Array.from(values, (x) => (Number.isNaN(x) ? 0 : x - finite)), 1), mark: new BufferAttribute(mark, 2) };
        this.attributes.set(values, a);
      }
      g.setAttribute("value", a.value);
      g.setAttribute("mark", a.mark);
      u.middle.value = a.middle;
    } else if (!g.getAttribute("value")) g.setAttribute("value", new BufferAttribute(new Float32Array(this.skin.count), 1));
    u.lo.value = lo;
    u.hi.value = hi;
  }

  draw() {
    if (this._waiting) return;
    this._waiting = true;
    requestAnimationFrame(() => { this._waiting = false; this.render(); });
  }

  render() {
    const r = this.renderer, c = r.domElement, w = c.clientWidth, h = c.clientHeight, n = this.layers.length;
    r.setScissorTest(false);
    r.clear();
    this.camera.getWorldDirection(this.uniforms.eye.value).negate();
    r.setScissorTest(true);
    this.layers.forEach((layer, k) => {
      r.setViewport((k * w) / n, 0, w / n, h);
      r.setScissor((k * w) / n, 0, w / n, h);
      this.#prepare(layer);
      r.render(this.scene, this.camera);
    });
    this.onDraw();
  }

  /** Hide what lies beyond a plane: `from` a side of VIEWS (the soles' is from below) or "top", a share of the extent away; null: nothing. */
  cut(from, share) {
    const d = from === null ? [0, 0, 0] : from === "top" ? [0, 1, 0] : VIEWS[from];
    const ends = [-1, 1].map((s) => d.reduce((sum, x, k) => sum + x * this.centre[k] + (s * Math.abs(x) * this.extent[k]) / 2, 0));
    this.uniforms.cut.value.set(...d, from === null ? 1 : ends[1] - share * (ends[1] - ends[0]));
    this.draw();
  }

  /** Turn by angles, rad: round the body's height, and up. */
  turn(azimuth, polar) {
    const p = this.camera.position.clone().sub(this.controls.target), r = p.length();
    const a = Math.atan2(p.x, p.z) + azimuth, b = Math.min(Math.max(Math.acos(p.y / r) + polar, 1e-3), Math.PI - 1e-3);
    this.camera.position.set(r * Math.sin(b) * Math.sin(a), r * Math.cos(b), r * Math.sin(b) * Math.cos(a)).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  zoom(factor) {
    this.camera.zoom *= factor;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  /** The skin under a point of the canvas (CSS px from its corner), and which pane it is in. */
  pick(x, y) {
    const ray = this.ray(x, y), [a, b, c, w] = this.uniforms.cut.value.toArray();
    const found = this.skin.hit(ray.origin, ray.direction, (p) => a * p.x + b * p.y + c * p.z <= w);
    return found && { ...found, pane: ray.pane };
  }

  ray(x, y) {
    const c = this.renderer.domElement, n = Math.max(this.layers.length, 1), w = c.clientWidth / n, h = c.clientHeight;
    const pane = Math.min(Math.max(Math.floor(x / w), 0), n - 1), cam = this.camera;
    cam.updateMatrixWorld();
    const u = ((x - pane * w) / w) * 2 - 1, v = 1 - (y / h) * 2, e = cam.matrixWorld.elements;
    const half = [(cam.right - cam.left) / 2 / cam.zoom, (cam.top - cam.bottom) / 2 / cam.zoom];
    const origin = [0, 1, 2].map((k) => e[12 + k] + u * half[0] * e[k] + v * half[1] * e[4 + k]);
    return { origin, direction: [-e[8], -e[9], -e[10]], pane };
  }

  /** Where a point of space stands on the canvas, CSS px, in the first pane. */
  project(p) {
    const c = this.renderer.domElement, n = Math.max(this.layers.length, 1), q = new Vector3(...p).project(this.camera);
    return [((q.x + 1) / 2) * (c.clientWidth / n), ((1 - q.y) / 2) * c.clientHeight];
  }

  get pxPerM() {
    const cam = this.camera;
    return (this.renderer.domElement.clientHeight * cam.zoom) / (cam.top - cam.bottom);
  }

  /** Lines on the skin: pairs of points. */
  lines(segments) {
    const lift = 1e-3, d = this.camera.getWorldDirection(new Vector3());
    set(this.marks.geometry, segments.flatMap((p) => [p[0] - lift * d.x, p[1] - lift * d.y, p[2] - lift * d.z]));
    this.draw();
  }

  frusta(segments) {
    set(this.cameras.geometry, segments.flat());
  }

  /** A picture of one side at a size, as a data URL; the screen's own camera comes back. */
  picture(name, width, height) {
    const c = this.renderer.domElement, keep = { position: this.camera.position.clone(), zoom: this.camera.zoom, target: this.controls.target.clone(), seen: this.seen, layers: this.layers };
    this.layers = this.layers.slice(0, 1);
    c.style.width = `${width}px`; c.style.height = `${height}px`;
    this.view(name);
    this.render();
    const url = c.toDataURL("image/png");
    c.style.width = c.style.height = "";
    Object.assign(this, { seen: keep.seen, layers: keep.layers });
    this.camera.position.copy(keep.position);
    this.camera.zoom = keep.zoom;
    this.controls.target.copy(keep.target);
    this.controls.update();
    this.resize();
    this.render();
    return url;
  }
}

const textures = new Map();
function texture(rgb) {
  if (!textures.has(rgb)) {
    const t = new DataTexture(rgb, 256, 1, RGBAFormat);
    t.minFilter = t.magFilter = NearestFilter;
    t.needsUpdate = true;
    textures.set(rgb, t);
  }
  return textures.get(rgb);
}

function colors(columns, n) {
  const out = new Uint8Array(3 * n).fill(200);
  if (columns.color) for (let i = 0; i < n; i++) for (let k = 0; k < 3; k++) out[3 * i + k] = columns.color[k * n + i];
  return out;
}

function set(geometry, numbers) {
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(numbers), 3));
}
