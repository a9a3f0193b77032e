// Opens every page of the built site in headless Chromium, as wide as a phone and as a desk, and fails where a page is wider
// than the screen, reports an error, lacks an image, or asks for anything that is not a file of the site.
//
//   NODE_PATH=FOLDER/node_modules node docs/tools/check_pages.mjs site [PICTURES]
//
// puppeteer-core is looked for in NODE_PATH; $CHROMIUM names the browser. With PICTURES, a folder, it keeps screenshots of
// the pages listed below.
import { createRequire } from "node:module";
import { mkdirSync, readdirSync } from "node:fs";
import { join, relative, resolve } from "node:path";
import { pathToFileURL } from "node:url";

const puppeteer = createRequire(import.meta.url)("puppeteer-core");
const WIDTHS = { phone: 390, desk: 1280 };
const PICTURED = [
  "index.html", "install.html", "concepts/diagnose.html", "concepts/simulate.html", "concepts/control.html",
  "api/residual.html", "results/diagnosis.html", "results/stiffness.html", "comparison.html",
];

const site = resolve(process.argv[2] ?? "site");
const pictures = process.argv[3];
if (pictures) mkdirSync(pictures, { recursive: true });
const pages = readdirSync(site, { recursive: true })
  // 404.html finds its style from the root of a server only
  .filter((name) => name.endsWith(".html") && !name.startsWith("assets") && name !== "404.html")
  .sort();
const browser = await puppeteer.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--no-sandbox", "--allow-file-access-from-files"],
});

const faults = [];
for (const [screen, width] of Object.entries(WIDTHS)) {
  const page = await browser.newPage();
  await page.setViewport({ width, height: width < 600 ? 844 : 800, isMobile: width < 600, hasTouch: width < 600 });
  let name = "";
  const fault = (what) => faults.push(`${name} (${screen}): ${what}`);
  page.on("console", (message) => message.type() === "error" && fault(`console: ${message.text()}`));
  page.on("pageerror", (error) => fault(`script: ${error.message}`));
  page.on("request", (request) => /^https?:/.test(request.url()) && fault(`asks for ${request.url()}`));
  page.on("requestfailed", (request) => fault(`cannot load ${relative(site, new URL(request.url()).pathname)}`));
  for (name of pages) {
    await page.goto(pathToFileURL(join(site, name)).href, { waitUntil: "load" });
    const { content, wide, broken } = await page.evaluate((width) => ({
      content: document.documentElement.scrollWidth,
      wide: [...document.querySelectorAll("article *")]
        .filter((one) => one.getBoundingClientRect().right > width + 1 && !one.closest("pre, table, math, .md-typeset__scrollwrap"))
        .slice(0, 3)
        .map((one) => `${one.tagName} ${one.textContent.slice(0, 40)}`),
      broken: [...document.images].filter((image) => image.complete && !image.naturalWidth).map((image) => image.src),
    }), width);
    if (content > width) fault(`${content} pixels wide: ${wide.join("; ")}`);
    for (const image of broken) fault(`no image ${image}`);
    if (pictures && PICTURED.includes(name)) {
      await page.screenshot({ path: join(pictures, `${name.replaceAll("/", "_").replace(".html", "")}_${screen}.png`) });
    }
  }
  await page.close();
}
await browser.close();
console.log([...faults, `${pages.length} pages at ${Object.values(WIDTHS).join(" and ")} pixels, ${faults.length} faults`].join("\n"));
process.exit(faults.length ? 1 : 0);
