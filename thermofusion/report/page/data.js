// What the page carries: facts as JSON, columns as gzip; undone as thermofusion/report/pack.py packed them.

export const facts = JSON.parse(document.getElementById("facts").textContent);

/** The columns by name: typed arrays, NaN where unmeasured. */
export async function columns() {
  const text = document.getElementById("columns").textContent.trim();
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const packed = new Uint8Array(await new Response(stream).arrayBuffer());
  const out = {};
  let at = 0;
  for (const column of facts.columns) {
    out[column.name] = unpack(packed.subarray(at, at + column.count * column.bytes), column);
    at += column.count * column.bytes;
  }
  return gathered(out);
}

/** Places and triangles put together; bytes of signed steps and of colours as they mean. */
function gathered(out) {
  const { x, y, z, a, b, c } = out, n = x.length, position = new Float32Array(3 * n), triangles = new Int32Array(3 * a.length);
  for (let i = 0; i < n; i++) { position[3 * i] = x[i]; position[3 * i + 1] = y[i]; position[3 * i + 2] = z[i]; }
  const from = (q, i) => a[i] + ((q[i] >>> 1) ^ -(q[i] & 1));
  for (let i = 0; i < a.length; i++) { triangles[3 * i] = a[i]; triangles[3 * i + 1] = from(b, i); triangles[3 * i + 2] = from(c, i); }
  for (const name of ["askew", "common"]) out[name] = out[name].map((q) => q - 127);
  if (out.color) out.color = out.color.map((q) => q * 4 + 2);
  out.flag = Float32Array.from(out.flags, (q, i) => (Number.isNaN(out.temperature[i]) ? NaN : Math.max(31 - Math.clz32(q & ~1), 0)));
  return { ...out, position, triangles };
}

/** Byte planes, then zigzag differences if asked, then floats: bits, linear steps, or squares of steps. */
function unpack(planes, { count, bytes, delta, code, step, offset, missing }) {
  const whole = new Int32Array(count);
  for (let b = 0; b < bytes; b++) {
    const plane = planes.subarray(b * count, (b + 1) * count);
    for (let i = 0; i < count; i++) whole[i] |= plane[i] << (8 * b);
  }
  if (delta) {
    let last = 0;
    for (let i = 0; i < count; i++) whole[i] = last = (last + ((whole[i] >>> 1) ^ -(whole[i] & 1))) | 0;
  }
  if (code === "float32") return new Float32Array(whole.buffer);
  if (code === "whole") return whole;
  const out = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const q = whole[i];
    out[i] = q === missing ? NaN : code === "square" ? step * q * q : offset + step * q;
  }
  return out;
}
