// Opens a page in headless Chromium and prints what it found, as JSON:
//   node browser.mjs <job.json>
// The job: {page, packages, files: {name: path}, playwright, chromium, width, height, seconds, screenshot}.
// Served on a port of its own: the page at /, the npm packages at /node_modules/, the files at /files/<name>.
// The page sets window.result, a value or a promise; it is waited for, and then a screenshot is taken.
import { createReadStream, readFileSync, realpathSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { extname, join, sep } from "node:path";

const job = JSON.parse(readFileSync(process.argv[2], "utf8"));
const { chromium } = createRequire(join(job.playwright, "package.json"))("playwright-core");
const types = { ".js": "text/javascript", ".mjs": "text/javascript", ".json": "application/json", ".wasm": "application/wasm" };
const modules = job.packages ? realpathSync(join(job.packages, "node_modules")) : null;

function fileOf(path) {
    if (path.startsWith("/files/")) return job.files[path.slice("/files/".length)];
    if (modules === null || !path.startsWith("/node_modules/")) return undefined;
    const file = join(modules, path.slice("/node_modules/".length));
    return file.startsWith(modules + sep) ? file : undefined;
}

const server = createServer((request, response) => {
    const path = decodeURIComponent(new URL(request.url, "http://localhost").pathname);
    if (path === "/") {
        response.writeHead(200, { "content-type": "text/html; charset=utf-8" });
        response.end(readFileSync(job.page));
        return;
    }
    const file = fileOf(path);
    const stream = file && createReadStream(file);
    if (!stream) {
        response.writeHead(404).end();
        return;
    }
    stream.on("error", () => response.writeHead(404).end());
    stream.on("open", () => {
        response.writeHead(200, { "content-type": types[extname(file)] ?? "application/octet-stream" });
        stream.pipe(response);
    });
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));

const browser = await chromium.launch({
    executablePath: job.chromium,
    args: [
        "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
        "--force-color-profile=srgb", "--hide-scrollbars",
    ],
});
const messages = [];
try {
    const page = await browser.newPage({ viewport: { width: job.width, height: job.height }, deviceScaleFactor: 1 });
    page.setDefaultTimeout(job.seconds * 1000);
    const failed = new Promise((_, reject) => page.on("pageerror", reject));
    failed.catch(() => {});
    page.on("console", (message) => messages.push(`${message.type()}: ${message.text()}`));
    page.on("requestfailed", (request) => messages.push(`failed: ${request.url()}`));
    const timeout = new Promise((_, reject) => setTimeout(() => reject(new Error("the page took too long")), job.seconds * 1000).unref());
    await page.goto(`http://127.0.0.1:${server.address().port}/`);
    const found = page.waitForFunction(() => "result" in window).then(() => page.evaluate(() => window.result));
    const result = await Promise.race([found, failed, timeout]);
    await page.screenshot({ path: job.screenshot });
    console.log(JSON.stringify({ result: result ?? null, messages }));
} catch (error) {
    console.log(JSON.stringify({ error: String(error), messages }));
} finally {
    await browser.close();
    server.close();
    server.closeAllConnections();
}
