// Works through jobs in one headless Chromium:
//   node browser.mjs PLAYWRIGHT CHROMIUM
// A line of stdin is a job, as JSON; its answer is a line of stdout. Each job has contexts of its own, which are
// closed at its end, and Chromium is started again where a job has ended it.
//   {page, packages, files: {name: path}, width, height, seconds, screenshot}: opens a page, which is served on a port
//   of its own: the page at /, the npm packages at /node_modules/, the files at /files/<name>. The page sets
//   window.result, a value or a promise; it is waited for, and then a screenshot is taken.
//   {steps, ...}: steps is a module, whose run(job, browser) gives the answer.
import { createReadStream, readFileSync, realpathSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { extname, join, sep } from "node:path";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [playwright, executablePath] = process.argv.slice(2);
const { chromium } = createRequire(join(playwright, "package.json"))("playwright-core");
const types = { ".js": "text/javascript", ".mjs": "text/javascript", ".json": "application/json", ".wasm": "application/wasm" };
const args = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--force-color-profile=srgb",
];

/** A server of a page, its packages and its files. */
async function serve(job) {
    const modules = job.packages ? realpathSync(join(job.packages, "node_modules")) : null;
    const fileOf = (path) => {
        if (path.startsWith("/files/")) return job.files[path.slice("/files/".length)];
        if (modules === null || !path.startsWith("/node_modules/")) return undefined;
        const file = join(modules, path.slice("/node_modules/".length));
        return file.startsWith(modules + sep) ? file : undefined;
    };
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
    return server;
}

/** Opens a page and waits for its result. */
async function show(job, browser) {
    const messages = [];
    const server = await serve(job);
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
        found.catch(() => {});
        const result = await Promise.race([found, failed, timeout]);
        await page.screenshot({ path: job.screenshot });
        return { result: result ?? null, messages };
    } catch (error) {
        return { error: String(error), messages };
    } finally {
        server.close();
        server.closeAllConnections();
    }
}

let browser;
for await (const line of createInterface({ input: process.stdin })) {
    const job = JSON.parse(line);
    if (!browser?.isConnected()) browser = await chromium.launch({ executablePath, args });
    let answer;
    try {
        answer = await (job.steps ? (await import(pathToFileURL(job.steps))).run(job, browser) : show(job, browser));
    } catch (error) {
        answer = { error: String(error.stack) };
    }
    if (browser.isConnected()) await Promise.all(browser.contexts().map((context) => context.close().catch(() => {})));
    process.stdout.write(`${JSON.stringify(answer)}\n`);
}
await browser?.close();
