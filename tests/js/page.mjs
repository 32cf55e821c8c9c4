// node page.mjs REPORT.html REGIONS.json FOLDER: uses a report as a person does; prints what it saw as JSON.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { chromium } from "playwright-core";

const [file, regions, folder] = process.argv.slice(2), url = `file://${file}`, seen = { requests: [], errors: [] };
const chromiumAt = process.env.CHROMIUM ?? "/usr/bin/chromium";
const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];

async function open(extra = []) {
  const browser = await chromium.launch({ executablePath: chromiumAt, args: [...args, ...extra] });
  const page = await browser.newPage({ viewport: { width: 1280, height: 900 }, acceptDownloads: true });
  page.on("request", (r) => /^(file|data|blob):/.test(r.url()) || seen.requests.push(r.url()));
  page.on("pageerror", (e) => seen.errors.push(e.message));
  page.on("console", (m) => m.type() === "error" && seen.errors.push(m.text()));
  page.on("dialog", (d) => { seen.errors.push(`dialog ${d.message()}`); d.dismiss(); });
  const start = Date.now();
  await page.goto(url, { waitUntil: "load" });
  return { browser, page, start, loaded: Date.now() };
}

const { browser, page, start, loaded } = await open();
await page.evaluate(() => window.thermofusion.ready);
seen.load_ms = loaded - start;
seen.first_picture_ms = Date.now() - loaded;
seen.title = await page.title();
seen.scripts = await page.evaluate(() => [...document.scripts].map((s) => s.type));

// picking, hovering, colours
seen.picks = await page.evaluate(() => {
  const c = document.getElementById("body"), t = window.thermofusion, ratio = c.width / c.clientWidth;
  t.rendered();
  const copy = Object.assign(document.createElement("canvas"), { width: c.width, height: c.height }), g = copy.getContext("2d");
  g.drawImage(c, 0, 0);
  const out = [];
  let seed = 1;
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  while (out.length < 200) {
    const x = Math.floor(random() * c.clientWidth) + 0.5, y = Math.floor(random() * c.clientHeight) + 0.5, p = t.pick(x, y);
    if (!p) continue;
    const px = [...g.getImageData(Math.floor(x * ratio), Math.floor(y * ratio), 1, 1).data];
    const near = [[-3, 0], [3, 0], [0, -3], [0, 3]].map(([dx, dy]) => t.pick(x + dx, y + dy));
    const inner = near.every((q) => q && Number.isFinite(q.temperature) && Math.hypot(...q.point.map((v, k) => v - p.point[k])) < 0.008); // no outline in between
    const times = performance.now();
    t.pick(x, y);
    out.push({ ray: t.ray(x, y), temperature: p.temperature, point: p.point, rgb: px.slice(0, 3), inner, ms: performance.now() - times });
  }
  return out;
});
const box = await page.locator("#body").boundingBox();
const at = (u, v) => [box.x + u * box.width, box.y + v * box.height];
await page.mouse.move(...at(0.5, 0.45));
await page.waitForFunction(() => document.getElementById("readout").textContent !== "");
seen.readout = await page.textContent("#readout");

// every map, side by side, palette, range, isotherms
seen.maps = {};
for (const id of await page.evaluate(() => thermofusion.facts.maps.map((m) => m.id))) {
  seen.maps[id] = await page.evaluate((id) => { thermofusion.map(id); thermofusion.rendered(); return document.getElementById("body").toDataURL().length; }, id);
}
const shot = () => page.evaluate(() => { thermofusion.rendered(); return document.getElementById("body").toDataURL(); });
await page.selectOption("#map", "0");
const plain = await shot(), changes = {};
const differs = async (name) => { changes[name] = (await shot()) !== plain; };
await page.selectOption("#beside", { label: "Apparent temperature" }); await differs("beside"); await page.selectOption("#beside", "-1");
await page.selectOption("#palette", "grey"); await differs("palette"); await page.selectOption("#palette", "inferno");
await page.fill("#low", "31"); await page.press("#low", "Enter"); await page.locator("#low").blur(); await differs("range"); await page.click("#auto");
await page.click("#display summary");
for (const id of ["shaded", "flagged", "beyond"]) { await page.check(`#${id}`); if (id !== "beyond") await differs(id); await page.uncheck(`#${id}`); }
await page.fill("#isotherms", "0.5"); await page.locator("#isotherms").blur(); await differs("isotherms");
await page.fill("#isotherms", "0"); await page.locator("#isotherms").blur();
const middle = () => page.evaluate(() => { const c = document.getElementById("body"); return thermofusion.pick(c.clientWidth / 2, c.clientHeight / 2); });
const whole = await middle();
await page.selectOption("#cut", "front"); await differs("cut");
seen.cut = { whole_z_m: whole.point[2], cut_z_m: (await middle())?.point[2] };
await page.selectOption("#cut", "");
await page.click("#display summary");
for (const [key, name] of [["2", "back"], ["3", "left"], ["5", "soles"]]) { await page.keyboard.press(key); await differs(name); }
seen.sides = await page.evaluate(() => { const out = {}; for (const v of ["front", "back"]) { thermofusion.view(v); thermofusion.rendered(); out[v] = document.getElementById("side-left").textContent + document.getElementById("side-right").textContent; } return out; });
await page.keyboard.press("1");
seen.same_again = (await shot()) === plain;
seen.changes = changes;

// spots, line, lasso, brush by hand
await page.keyboard.press("s");
await page.mouse.click(...at(0.47, 0.4));
await page.mouse.click(...at(0.53, 0.5));
await page.keyboard.press("l");
await page.mouse.click(...at(0.46, 0.3));
await page.mouse.click(...at(0.55, 0.6));
const drag = async (points) => { await page.mouse.move(...at(...points[0])); await page.mouse.down(); for (const p of points.slice(1)) await page.mouse.move(...at(...p), { steps: 4 }); await page.mouse.up(); };
await page.keyboard.press("r");
await drag([[0.46, 0.35], [0.54, 0.35], [0.55, 0.5], [0.47, 0.52], [0.46, 0.36]]);
await page.keyboard.press("b");
await drag([[0.48, 0.55], [0.52, 0.55]]);
await page.keyboard.press("Escape");
await page.setInputFiles("#load", regions);
await page.waitForFunction(() => thermofusion.regions().regions.length >= 7);
const download = async (button, name) => { const [d] = await Promise.all([page.waitForEvent("download"), page.click(button)]); await d.saveAs(`${folder}/${name}`); };
await download("#csv", "page.csv");
await download("#save", "page.json");
await download("#picture", "page.png");
seen.rows = await page.locator("#list tbody tr").count();
await page.setInputFiles("#load", { name: "x.json", mimeType: "application/json", buffer: Buffer.from('{"schema":"thermofusion-regions/9"}') });
await page.waitForFunction(() => document.getElementById("fault").textContent !== "");
seen.refused = await page.textContent("#fault");
seen.loaded_names = await page.evaluate(() => [...document.querySelectorAll("#list input")].map((i) => i.value));

// accessibility, in both colour schemes; print; phone
const axe = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
seen.axe = [];
for (const colorScheme of ["light", "dark"]) {
  await page.emulateMedia({ colorScheme });
  await page.evaluate(axe);
  const found = await page.evaluate(() => axe.run(document, { resultTypes: ["violations"] }));
  seen.axe.push(...found.violations.filter((v) => ["serious", "critical"].includes(v.impact)).map((v) => `${colorScheme} ${v.id}: ${v.nodes.map((n) => n.target).slice(0, 4).join(" ")}`));
}
await page.emulateMedia({ colorScheme: "light" });
const pdf = await page.pdf({ path: `${folder}/page.pdf`, preferCSSPageSize: true });
seen.pdf = { bytes: pdf.length, shots: await page.locator("#shots img").count() };
await page.setViewportSize({ width: 390, height: 844 });
seen.phone_overflow = await page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);
await browser.close();

// no WebGL: the pictures stand in
const poor = await open(["--disable-3d-apis"]);
await poor.page.evaluate(() => window.thermofusion.ready.catch(() => {}));
seen.without = await poor.page.evaluate(() => ({
  picture: document.querySelector("#pictures img").getBoundingClientRect().height, stage: document.getElementById("stage").hidden,
  fault: document.getElementById("fault").textContent, tables: document.querySelectorAll(".below table").length,
}));
await poor.browser.close();
seen.errors = seen.errors.filter((e) => !e.includes("WebGL") && !/offers no/.test(e));
console.log(JSON.stringify(seen));
