// npm ci && node build.mjs: writes page.html, the report's template, with script, style and licences inside.
// node build.mjs --check: says whether the committed page.html is what these sources give.
import { createHash } from "node:crypto";
import { readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

process.chdir(import.meta.dirname);
const hash = (text) => "sha256-" + createHash("sha256").update(text).digest("base64");
const bundle = async (entry) => {
  const out = await build({ entryPoints: [entry], absWorkingDir: import.meta.dirname, bundle: true, minify: true, format: "esm", target: "es2022", write: false, charset: "utf8", legalComments: "none" });
  return out.outputFiles[0].text.trim().replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
};
const script = await bundle("main.js"), style = await bundle("style.css");
const licences = ["three", "three-mesh-bvh"].map((name) => `${name}\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`).join("\n\n");
const parts = { "@SCRIPT-HASH@": hash(script), "@STYLE-HASH@": hash(style), "@STYLE@": style, "@LICENCES@": licences, "@SCRIPT@": script };
const page = readFileSync("template.html", "utf8").replace(/@[A-Z-]+@/g, (name) => parts[name] ?? name);
if (process.argv.includes("--check")) {
  if (readFileSync("page.html", "utf8") !== page) throw new Error("page.html is not what the sources give: run node build.mjs");
} else {
  writeFileSync("page.html", page);
  writeFileSync("page.html.sha256", createHash("sha256").update(page).digest("hex") + "  page.html\n");
}
console.log(`page.html: ${page.length} characters, ${hash(page)}`);
