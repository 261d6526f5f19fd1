// Steps through the pages in headless Chromium, which `tests/support/browser.mjs` has started. The job is {name, url,
// shots, seconds, ...}; the answer is what the steps found, with everything that a browser complains of.
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";

let job, browser, complaints;

async function open({ width = 1200, height = 860, signedIn = true, ...options } = {}) {
    const context = await browser.newContext({ viewport: { width, height }, ...options });
    context.setDefaultTimeout(job.seconds * 1000);
    if (signedIn) await context.request.post(`${job.url}/sign-in`, { form: { token: job.token }, maxRedirects: 0 });
    const page = await context.newPage();
    page.on("pageerror", (error) => complaints.push(`error: ${error.message}`));
    page.on("console", (message) => {
        // What the steps break on purpose is no complaint.
        if (message.type() === "error" && !/ERR_(FAILED|ABORTED|CONNECTION|NETWORK_CHANGED)/.test(message.text())) complaints.push(`console: ${message.text()} ${message.location().url}`);
    });
    return steadily(page);
}

/** The page, whose visits begin anew where the machine's network changed meanwhile: Chromium then drops what is on its way, also from this machine itself. */
function steadily(page) {
    let dropped = false;
    const visit = page.goto.bind(page);
    page.on("requestfailed", (request) => { dropped ||= /ERR_NETWORK_CHANGED/.test(request.failure()?.errorText ?? ""); });
    page.goto = async (address, options) => {
        for (let left = 5; ; left -= 1) {
            dropped = false;
            const answer = await visit(address, options).catch((error) => {
                // The page of the error that Chromium shows for the visit before may come only now and end this one.
                if (!/ERR_NETWORK_CHANGED|navigation to "chrome-error:/.test(error.message) || left === 0) throw error;
                dropped = true;
            });
            if (!dropped || left === 0) return answer;
            await page.waitForTimeout(500);
        }
    };
    return page;
}

/** A picture for the eye, where a folder for them is given. */
const shot = async (page, name, fullPage = true) => { if (job.shots) await page.screenshot({ path: join(job.shots, `${name}.png`), fullPage }); };
const overflow = (page) => page.evaluate(() => document.documentElement.scrollWidth - document.documentElement.clientWidth);

/** Names of all controls that a screen reader would find nameless. */
const nameless = (page) => page.evaluate(() => [...document.querySelectorAll("a, button, input:not([type=hidden]), select, canvas, progress, img")]
    .filter((part) => part.checkVisibility() && !part.parentElement.closest("[role=img]"))
    .filter((part) => {
        const labelled = part.getAttribute("aria-label") || part.getAttribute("aria-labelledby") || part.labels?.length || part.textContent.trim() || part.title;
        return part.tagName === "IMG" ? part.getAttribute("alt") === null : !labelled && part.getAttribute("aria-hidden") !== "true";
    })
    .map((part) => part.outerHTML.slice(0, 200)));

/** Mean and spread of the brightness of what the viewer shows. */
async function brightness(page) {
    const clip = await page.locator("#viewer canvas:not(.overlay)").boundingBox();
    const png = (await page.screenshot({ clip })).toString("base64");
    return page.evaluate(async (data) => {
        const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
        const image = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
        const canvas = new OffscreenCanvas(image.width, image.height), context = canvas.getContext("2d");
        context.drawImage(image, 0, 0);
        const { data: pixels } = context.getImageData(0, 0, image.width, image.height);
        let sum = 0, squares = 0, count = 0;
        for (let k = 0; k < pixels.length; k += 4) { const v = (pixels[k] + pixels[k + 1] + pixels[k + 2]) / 3; sum += v; squares += v * v; count += 1; }
        return { mean: sum / count, deviation: Math.sqrt(squares / count - (sum / count) ** 2) };
    }, png);
}

/** What axe finds of serious or critical faults. */
async function faults(page) {
    if (!job.axe) return [];
    await page.evaluate(readFileSync(join(job.axe, "axe.min.js"), "utf8"));
    const { violations } = await page.evaluate(() => axe.run(document, { resultTypes: ["violations"] }));
    return violations.filter(({ impact }) => ["serious", "critical"].includes(impact)).map(({ id, nodes }) => `${id}: ${nodes.slice(0, 3).map((node) => node.html.slice(0, 160)).join(" | ")}`);
}

/** Pictures of a page at both widths, one light and one dark, and what axe says of them; all four where pictures are asked for. */
async function portray(path, name, prepare = async () => {}) {
    const found = [];
    for (const [width, colorScheme] of [[1280, "light"], [390, "dark"], ...(job.shots ? [[1280, "dark"], [390, "light"]] : [])]) {
        const page = await open({ width, height: 860, colorScheme });
        await page.goto(`${job.url}${path}`);
        await prepare(page);
        await shot(page, `${name}_${width}_${colorScheme}`);
        found.push(...(await faults(page)).map((fault) => `${width} ${colorScheme} ${fault}`));
        const wide = await overflow(page);
        if (wide > 0) found.push(`${width} ${colorScheme} is ${wide} px too wide`);
        if (width === 1280) found.push(...await nameless(page));
        await page.context().close();
    }
    return found;
}

const steps = {
    /** A folder is chosen; half of it arrives and the page is left; the second time only the rest is sent. */
    async flow() {
        const found = {};
        let page = await open();
        await page.goto(`${job.url}/`);
        found.empty = await page.locator(".empty h2").textContent();
        await shot(page, "empty");
        const puts = [];
        const listenTo = (page) => page.on("request", (request) => { if (request.method() === "PUT") puts.push(decodeURIComponent(new URL(request.url()).pathname.split("/files/")[1])); });

        listenTo(page);
        let let_through = job.first, arrived = 0;
        page.on("requestfinished", (request) => { if (request.method() === "PUT" && request.url().includes("/files/")) arrived += 1; });
        await page.route("**/files/**", (route) => {
            if (route.request().method() !== "PUT" || let_through-- > 0) route.continue();
            else route.abort("connectionfailed");
        });
        await page.goto(`${job.url}/new`);
        await page.setInputFiles("#pick-folder", job.folder);
        const chosen = (words) => page.waitForFunction((words) => document.getElementById("chosen-text").textContent.includes(words), words).then(async () => ({ text: await page.textContent("#chosen-text"), notes: await page.locator("#chosen-notes li").allTextContents() }));
        found.chosen = await chosen("still life: ");
        await page.click("#forget");
        await page.setInputFiles("#pick-files", job.empty);
        await page.waitForFunction(() => !document.getElementById("faults").hidden);
        found.refused = await page.locator("#faults li").allTextContents();
        await page.setInputFiles("#pick-files", job.archive);
        found.chosenArchive = await chosen(".zip");
        await page.click("#forget");
        await page.setInputFiles("#pick-folder", job.folder);
        await chosen("still life: ");
        await page.click("#start");
        await page.waitForFunction(() => /connection is lost/.test(document.getElementById("going-text").textContent));
        while (arrived < job.first) await page.waitForTimeout(50); // several are sent at once
        await shot(page, "interrupted");
        await page.context().close();
        found.firstPuts = puts.splice(0);

        page = await open();
        listenTo(page);
        await page.goto(`${job.url}/new`);
        await shot(page, "new");
        await page.setInputFiles("#pick-folder", job.folder);
        await page.check("[data-path=preset] [value=fast]");
        found.iterationsHint = await page.getAttribute("[data-path='train.iterations']", "placeholder");
        await page.fill("#label", "a still life");
        await page.click("details.all summary");
        const estimate = (words) => page.waitForFunction((words) => document.getElementById("estimate").textContent.includes(words), words).then((shown) => page.textContent("#estimate"));
        found.estimate = await estimate("of memory");
        await page.fill("[data-path='train.iterations']", "1000000000");
        found.tooMuch = await estimate("100000");
        for (const [path, value] of Object.entries(job.options)) await page.fill(`[data-path='${path}']`, String(value));
        for (const box of await page.locator("[data-path=exports] [type=checkbox]:enabled").all()) await box.setChecked(job.exports.includes(await box.inputValue()));
        found.estimateAnew = await estimate("of memory");
        await shot(page, "new_settings");
        found.namelessOnNew = await nameless(page);
        await page.click("#start");
        await page.waitForURL("**/jobs/*-*");
        found.secondPuts = puts.splice(0);
        found.job = page.url().split("/").pop();
        return found;
    },

    /** Each folder or file is sent and its job queued; of the first one `cut` parts arrive before the page is left. */
    async sent() {
        const found = { puts: [], jobs: [] };
        const send = async (chosen, cut = Infinity) => {
            const page = await open(), puts = [];
            let arrived = 0, begun = 0;
            page.on("requestfinished", async (request) => { if (request.method() === "PUT" && (await request.response())?.ok()) arrived += 1; });
            await page.route("**/v1/datasets/**", (route) => {
                const request = route.request();
                if (request.method() !== "PUT") return route.continue();
                if (begun++ >= cut) return route.abort("connectionfailed");
                puts.push(decodeURIComponent(new URL(request.url()).pathname.split("/").slice(4).join("/")).replace(/[0-9a-f-]{36}/, "ID"));
                return route.continue();
            });
            await page.goto(`${job.url}/new`);
            await page.setInputFiles(chosen.endsWith(".zip") ? "#pick-files" : "#pick-folder", chosen);
            await page.waitForFunction(() => document.getElementById("chosen-text").textContent);
            await page.click("#start");
            if (cut < Infinity) {
                await page.waitForFunction(() => /connection is lost/.test(document.getElementById("going-text").textContent));
                while (arrived < cut) await page.waitForTimeout(50);
                await shot(page, "large_interrupted");
            } else {
                await page.waitForURL("**/jobs/*-*");
                found.jobs.push(page.url().split("/").pop());
            }
            await page.context().close();
            found.puts.push(puts.sort());
        };
        await send(job.chosen[0], job.cut);
        for (const chosen of job.chosen) await send(chosen);
        return found;
    },

    /** One file of a folder is refused while others are on their way; how many are begun after that is told. */
    async refused() {
        const page = await open();
        let begun = 0, late = 0, isTold = false;
        await page.route("**/v1/datasets/**", async (route) => {
            const request = route.request();
            if (request.method() !== "PUT") return route.continue();
            begun += 1;
            late += isTold;
            const isBad = request.url().endsWith("bad.png");
            if (!isBad) await new Promise((resolve) => setTimeout(resolve, isTold ? 0 : 2000)); // on their way until the other is refused
            return route.continue().catch(() => {});
        });
        await page.goto(`${job.url}/new`);
        await page.setInputFiles("#pick-folder", job.chosen);
        await page.waitForFunction(() => document.getElementById("chosen-text").textContent);
        await page.click("#start");
        await page.waitForFunction(() => !document.getElementById("faults").hidden);
        isTold = true;
        const faults = await page.locator("#faults li").allTextContents();
        await page.waitForTimeout(2500); // the first try again would come after 0.6 s
        return { begun, late, faults, going: await page.isVisible("#going") };
    },

    /** A job that waits, runs and ends while its page and the list are open; nothing is reloaded by hand. */
    async watch() {
        const page = await open(), list = await open();
        // The pages themselves note what they show, also between two looks from here and across a reload.
        const note = () => {
            const noted = JSON.parse(sessionStorage.getItem("noted") ?? '{"states": [], "list": [], "stages": [], "curves": 0, "preview": false}');
            const add = (list, value) => { if (value && list.at(-1) !== value) list.push(value); };
            const look = () => {
                const state = document.getElementById("status")?.dataset.state;
                add(noted.states, state);
                add(noted.list, document.querySelector(".job .chip")?.textContent);
                if (state === "running") {
                    add(noted.stages, document.querySelector(".stages .now")?.firstChild.textContent.trim());
                    noted.curves = Math.max(noted.curves, document.querySelectorAll(".chart canvas").length);
                    noted.preview ||= document.querySelector("#preview .below") !== null;
                }
                sessionStorage.setItem("noted", JSON.stringify(noted));
            };
            document.addEventListener("DOMContentLoaded", () => {
                look();
                new MutationObserver(look).observe(document.body, { subtree: true, childList: true, characterData: true, attributes: true, attributeFilter: ["data-state", "class"] });
            });
        };
        for (const each of [page, list]) await each.addInitScript(note);
        await list.goto(`${job.url}/`);
        await page.goto(`${job.url}/jobs/${job.job}`);
        await shot(page, "job_queued");
        await page.waitForSelector("#status[data-state=running], #status[data-state=succeeded]");
        // Pictures for the eye, as far as the job is slow enough for them.
        const curves = page.waitForFunction(() => document.querySelectorAll(".chart canvas").length === 3 || document.querySelector("#status[data-state=succeeded]"));
        await curves.then(() => shot(page, "job_running"), () => {});
        await page.waitForSelector("#status[data-state=succeeded], #status[data-state=failed], #status[data-state=canceled]");
        await list.waitForFunction(() => ["Done", "Failed", "Cancelled"].includes(document.querySelector(".job .chip")?.textContent));
        await shot(list, "jobs");
        await page.waitForSelector("#viewer[data-ready=yes]");
        await page.waitForTimeout(700);
        await shot(page, "result");
        const view = await brightness(page);
        await page.locator("#log-fold summary").click();
        await page.waitForFunction(() => document.getElementById("log").textContent.includes("Succeeded"));
        await shot(page, "log");
        const noted = (page) => page.evaluate(() => JSON.parse(sessionStorage.getItem("noted")));
        const { states, stages, curves: live, preview } = await noted(page);
        return {
            states, stages, preview, liveCurves: live, list: (await noted(list)).list,
            curves: await page.locator(".chart canvas").count(),
            figures: await page.locator(".chart output").allInnerTexts(),
            log: await page.locator("#log").innerText(),
            view,
            nameless: [...await nameless(page), ...await nameless(list)],
            overflow: await overflow(page),
        };
    },

    /** The result by pointer: sorting, another view, the difference, the report, a download. */
    async result() {
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        const column = (k) => page.locator(".sortable tbody tr").evaluateAll((rows, k) => rows.map((row) => row.cells[k].dataset.sort), k);
        const found = { worstFirst: (await column(1)).map(Number) };
        await page.click(".sortable thead th:nth-child(2) button");
        found.bestFirst = (await column(1)).map(Number);
        await page.click(".sortable thead th:first-child button");
        found.byName = await column(0);
        await page.locator(".sortable tbody tr").nth(1).click();
        found.shown = await page.locator(".view-name").textContent();
        await page.waitForFunction(() => [...document.querySelectorAll("#view-shown img")].every((image) => image.complete && image.naturalWidth > 0));
        found.boxes = await page.evaluate(() => [".below", ".above"].map((name) => { const box = document.querySelector(`#view-shown ${name}`).getBoundingClientRect(); return [box.x, box.y, box.width, box.height].map(Math.round); }));
        await page.click("[data-mode=difference]");
        await shot(page, "difference");
        const download = page.waitForEvent("download");
        await page.click(".files-list a[href$='metrics.json']");
        found.download = (await download).suggestedFilename();
        const [report] = await Promise.all([page.context().waitForEvent("page"), page.click("text=Open the report")]);
        await report.waitForLoadState();
        found.report = await report.title();
        found.reportRuns = await report.evaluate(() => document.documentElement.classList.contains("js") || document.querySelectorAll(".strip button").length > 0);
        found.reportOrigin = await report.evaluate(() => self.origin);
        await shot(report, "report", false);
        const before = await page.locator("#viewer").getAttribute("data-ready");
        await page.waitForSelector("#viewer[data-ready=yes]");
        found.viewerReady = before !== "failed";
        return found;
    },

    /** A training is watched in 3D: sparse points, then a state, its cameras, a held-out view and its photograph. */
    async live() {
        const found = {};
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        found.before = await page.textContent("#viewer .veil-text");
        writeFileSync(join(job.signals, "opened"), "");
        const counted = (words) => page.waitForFunction((words) => document.querySelector("#viewer .count")?.textContent.includes(words), words);
        await counted("sparse points");
        await page.waitForSelector("#viewer[data-ready=yes]");
        await shot(page, "live_points");
        writeFileSync(join(job.signals, "points"), "");
        await counted("Step 30");
        await page.waitForSelector("#viewer[data-rested=yes]");
        // One change is one drawing of the lines over the scene, however many frames pass until the camera rests.
        found.overlayDraws = await page.evaluate(async () => {
            const own = CanvasRenderingContext2D.prototype.clearRect, { dataset } = document.querySelector("#viewer");
            let draws = 0;
            CanvasRenderingContext2D.prototype.clearRect = function (...sides) { draws += 1; own.apply(this, sides); };
            const next = (until) => new Promise((resolve) => { const look = () => (until() ? resolve() : requestAnimationFrame(look)); look(); });
            document.querySelector("#viewer [data-do=background]").click();
            await next(() => dataset.rested === "no");
            await next(() => dataset.rested === "yes" && dataset.drawn === "all");
            CanvasRenderingContext2D.prototype.clearRect = own;
            return draws;
        });
        await page.click("#viewer [data-do=background]");
        found.count = await page.textContent("#viewer .count");
        found.views = await page.locator("#viewer .views option").allTextContents();
        found.unplaced = [await page.textContent("#viewer .unplaced summary"), ...await page.locator("#viewer .unplaced li").evaluateAll((items) => items.map((item) => item.textContent))];
        const marks = () => page.evaluate(() => { const canvas = document.querySelector("#viewer .overlay"); return canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.filter((value, k) => k % 4 === 3 && value > 0).length; });
        found.marks = [await marks()];
        await page.click("#viewer [data-do=cameras]");
        await page.waitForTimeout(300);
        found.marks.push(await marks());
        const held = found.views.findIndex((name) => name.endsWith("(held out)"));
        await page.selectOption("#viewer .views", String(held - 1));
        found.place = await page.textContent("#viewer .place");
        await page.selectOption("#viewer .photo-mode", "over");
        await page.waitForSelector("#viewer .photo:not([hidden])");
        found.photograph = await page.evaluate(async () => {
            const image = document.querySelector("#viewer .photo");
            await image.decode();
            // As the page lays it out, before it is turned as its camera was.
            const { offsetWidth: width, offsetHeight: height } = image;
            return { alt: image.alt, width: image.naturalWidth, ratio: width / height, covers: height / image.parentElement.clientHeight };
        });
        await page.waitForTimeout(500);
        await shot(page, "live_photograph");
        await page.focus("#viewer canvas:not(.overlay)");
        await page.keyboard.press("ArrowLeft");
        await page.waitForFunction(() => document.querySelector("#viewer .photo").hidden);
        await page.selectOption("#viewer .photo-mode", "corner");
        found.corner = await page.isVisible("#viewer .photo");
        await shot(page, "live_cameras");
        found.faults = await portray(`/jobs/${job.job}`, "live", (other) => other.waitForSelector("#viewer[data-rested=yes]"));
        return found;
    },

    /** The pages around jobs at both widths, light and dark; and what a form of a new job says of the presets. */
    async portraits() {
        const found = { faults: {} };
        for (const [name, path] of Object.entries(job.paths)) {
            found.faults[name] = await portray(path, name, async (page) => {
                if (path.startsWith("/compare")) found.compared = await page.locator("tbody tr").evaluateAll((rows) => rows.map((row) => [...row.cells].map((cell) => cell.textContent.trim())));
                if (!path.startsWith("/new")) return;
                await page.waitForFunction(() => document.querySelectorAll(".preset-estimate:not(:empty)").length === 4);
                found.estimates = await page.locator(".preset-estimate").allTextContents();
                await page.check("[data-path=preset] [value=high]");
                await page.waitForTimeout(800);
                found.chosen = await page.textContent("#estimate");
            });
        }
        return found;
    },

    /** Several archives become a job each. */
    async many() {
        const page = await open();
        await page.goto(`${job.url}/new`);
        await page.setInputFiles("#pick-files", job.archives);
        await page.waitForFunction(() => document.getElementById("chosen-text").textContent.includes("2 scenes"));
        const found = { chosen: await page.textContent("#chosen-text"), notes: await page.locator("#chosen-notes li").allTextContents(), button: await page.textContent("#start") };
        await page.fill("#label", "evening");
        await page.check("[data-path=preset] [value=fast]");
        await page.click("#start");
        await page.waitForURL(`${job.url}/`);
        found.names = await page.locator(".job .title a").allTextContents();
        return found;
    },

    /** A job like another one begins with its Gaussians. */
    async begin() {
        const found = {};
        const page = await open();
        await page.goto(`${job.url}/new?like=${job.job}`);
        found.words = (await page.locator("label", { has: page.locator("#begin-with") }).textContent()).trim();
        await page.check("#begin-with");
        await page.click("#start");
        await page.waitForURL(`${job.url}/jobs/*`);
        found.job = page.url().split("/").at(-1);
        found.source = await page.textContent(".source");
        found.faults = await portray(`/new?like=${job.job}`, "begin");
        return found;
    },

    /** A job in its training, and then in the fit of residual colors; the test tells of each when the page is ready for it. */
    async fit() {
        const found = {};
        const page = await open();
        const ready = (signal) => writeFileSync(join(job.signals, signal), "");
        const bar = () => page.locator("#status .bar-text").innerText();
        const barSays = (words) => page.waitForFunction((words) => document.querySelector("#status .bar-text")?.textContent.includes(words), words);
        const stages = () => page.locator("#status .stages li").evaluateAll((items) => items.map((item) => [item.firstChild.textContent.trim(), item.className, item.getAttribute("aria-current")]));
        // The page itself notes what its bar says, as it is told anew every few seconds.
        await page.addInitScript(() => {
            window.bars = [];
            document.addEventListener("DOMContentLoaded", () => {
                const look = () => { const text = document.querySelector("#status .bar-text")?.textContent; if (text && window.bars.at(-1) !== text) window.bars.push(text); };
                look();
                new MutationObserver(look).observe(document.body, { subtree: true, childList: true, characterData: true });
            });
        });
        await page.goto(`${job.url}/jobs/${job.job}`);
        await barSays("30/60");
        ready("opened");
        await barSays("50/60");
        found.trained = await stages();
        ready("trained");
        await page.waitForFunction(() => document.querySelector("#status .stages .now")?.firstChild.textContent.trim() === "residual");
        await barSays("residual");
        ready("fits");
        await barSays("40/96");
        found.fits = await stages();
        found.bar = await bar();
        found.bars = await page.evaluate(() => window.bars);
        await shot(page, "residual");
        found.faults = await portray(`/jobs/${job.job}`, "residual");
        return found;
    },

    /** A job that was cancelled goes on with other files to write. */
    async goOn() {
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.click("#go-on > summary");
        const box = page.locator("#go-on input[value='scene.spz']");
        await box.check();
        await page.click("#go-on [type=submit]");
        await page.waitForSelector("#status[data-state=queued]");
        return {};
    },

    /** On a result: a distance, a note that stays, a link to a view, and a crop that is seen and then asked for. */
    async edit() {
        const found = {};
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        const ready = () => page.waitForSelector("#viewer[data-rested=yes]");
        await ready();
        const at = async (x, y) => {
            const { width, height } = await page.locator("#viewer canvas:not(.overlay)").boundingBox();
            await page.locator("#viewer canvas:not(.overlay)").click({ position: { x: x * width, y: y * height } });
        };
        await page.click("#viewer [data-do=measure]");
        await at(0.45, 0.5);
        await page.waitForFunction(() => /second/.test(document.querySelector("#viewer .place").textContent));
        await at(0.55, 0.5);
        await page.waitForSelector("#viewer[data-distance]");
        found.distance = [Number(await page.getAttribute("#viewer", "data-distance")), await page.textContent("#viewer .place")];
        await shot(page, "measure", false);
        await page.click("#viewer [data-do=note]");
        await page.focus("#viewer canvas:not(.overlay)");
        await page.keyboard.press("Enter");
        await page.waitForSelector("#viewer .note-form:not([hidden])");
        await page.fill("#note-text", "the middle <b>");
        await page.keyboard.press("Enter");
        await page.waitForSelector("#viewer .view-notes li");
        await page.focus("#viewer canvas:not(.overlay)");
        for (const key of ["ArrowLeft", "ArrowUp"]) await page.keyboard.press(key);
        await page.waitForTimeout(200);
        await ready();
        await page.click("#viewer [data-do=link]");
        await page.waitForFunction(() => location.hash);
        const hash = await page.evaluate(() => location.hash);
        await page.goto("about:blank");
        await page.goto(`${job.url}/jobs/${job.job}${hash}`);
        await ready();
        await page.click("#viewer [data-do=link]");
        await page.waitForTimeout(100);
        found.links = [hash, await page.evaluate(() => location.hash)];
        found.notes = await page.locator("#viewer .view-notes li button:first-child").allTextContents();
        await page.click("#edit > summary");
        await page.waitForSelector("#viewer[data-edited]"); // as nothing is ticked, nothing goes
        const all = JSON.parse(await page.getAttribute("#viewer", "data-edited")).kept;
        await page.check("#edit [name=clean]");
        await page.waitForFunction((all) => JSON.parse(document.getElementById("viewer").dataset.edited).kept < all, all);
        found.cleaned = JSON.parse(await page.getAttribute("#viewer", "data-edited"));
        await page.uncheck("#edit [name=clean]");
        await page.check("#edit [name=crop]");
        await page.locator("#edit [name=x_low]").focus();
        for (let k = 0; k < 40; k++) await page.keyboard.press("ArrowRight");
        await page.waitForFunction(() => (JSON.parse(document.getElementById("viewer").dataset.edited).outside ?? 0) > 0);
        await page.waitForTimeout(700);
        found.cropped = JSON.parse(await page.getAttribute("#viewer", "data-edited"));
        found.said = await page.textContent("#edit .edit-state");
        await ready();
        await shot(page, "crop");
        const look = async () => {
            await page.evaluate(() => document.querySelector("#viewer .screen").scrollIntoView({ block: "center" }));
            await page.waitForTimeout(300);
            return (await brightness(page)).mean;
        };
        const shown = await look();
        await page.click("#edit [data-show=removed]");
        await page.waitForTimeout(400);
        await ready();
        found.differs = Math.abs(await look() - shown);
        found.faults = await portray(`/jobs/${job.job}`, "edit", async (other) => {
            await other.waitForSelector("#viewer[data-rested=yes]");
            await other.click("#edit > summary");
            await other.check("#edit [name=crop]");
            await other.check("#edit [name=clean]");
            await other.waitForTimeout(800);
        });
        // The same box for a new training: the form has it, and shows it.
        const again = await page.context().newPage();
        await again.goto(new URL(await page.getAttribute("#edit-region", "href"), job.url).href);
        await again.waitForFunction(() => document.querySelector("[data-path=region]")?.value);
        found.region = await again.inputValue("[data-path=region]");
        found.regionShown = await again.isVisible("[data-path=region]");
        await again.close();
        await page.click("#edit [value=crop]");
        await page.waitForURL((url) => !url.pathname.endsWith(job.job) && url.pathname.startsWith("/jobs/"));
        found.job = page.url().split("/").pop();
        return found;
    },

    /** The page of one scene, as octasplat.view serves it. */
    async scene() {
        const page = await open();
        await page.goto(job.url);
        await page.waitForSelector("#viewer[data-ready=yes]");
        await page.waitForTimeout(500);
        return { heading: await page.textContent("h1"), count: await page.textContent("#viewer .count"), shown: await brightness(page) };
    },

    /** What a page shows at first, and after its button for materials. */
    async materials() {
        const page = await open();
        await page.goto(job.url);
        await page.waitForSelector("#viewer[data-ready=yes]");
        const button = page.locator("#viewer [data-do=materials]"), found = { looks: [], lit: [], pressed: [] };
        const note = async () => {
            await page.waitForSelector("#viewer[data-rested=yes][data-drawn=all]");
            await page.waitForTimeout(500);
            await page.waitForSelector("#viewer[data-rested=yes][data-drawn=all]");
            found.looks.push((await brightness(page)).mean);
            found.lit.push(await page.getAttribute("#viewer", "data-lit"));
            found.pressed.push(await button.isVisible() && await button.getAttribute("aria-pressed"));
        };
        if (job.lit) await page.waitForSelector("#viewer[data-lit=learnt]");
        await note();
        await shot(page, "view_first", false);
        if (await button.isVisible()) for (let k = 0; k < 2; k++) {
            await button.click();
            await note();
            if (k === 0) await shot(page, "view_harmonics", false);
        }
        return found;
    },

    /** From the list to the viewer and back with keys alone; nothing is clicked. */
    async keyboard() {
        const found = {};
        const page = await open({ width: 760, height: 600 });
        await page.goto(`${job.url}/`);
        await page.keyboard.press("Tab");
        found.first = await page.evaluate(() => document.activeElement.textContent);
        const tabTo = async (matches, most = 120) => {
            for (let k = 0; k < most; k++) {
                if (await page.evaluate(matches, job.job)) return k;
                await page.keyboard.press("Tab");
            }
            throw new Error(`${matches} was not reached`);
        };
        await tabTo((id) => document.activeElement.id === `name-${id}`);
        // The list renews itself under the focus.
        await page.waitForTimeout(2600);
        found.keepsFocus = await page.evaluate((id) => document.activeElement.id === `name-${id}`, job.job);
        await page.keyboard.press("Enter");
        await page.waitForURL("**/jobs/*-*");
        await page.waitForSelector("#viewer[data-ready=yes]");
        await tabTo(() => document.activeElement.tagName === "CANVAS");
        const picture = () => page.locator("#viewer canvas:not(.overlay)").screenshot().then((png) => png.toString("base64"));
        // The picture once it stands still.
        const still = async () => {
            await page.waitForSelector("#viewer[data-rested=yes]");
            for (let before = await picture(), k = 0; ; k++) {
                await page.waitForTimeout(150);
                const now = await picture();
                if (now === before || k > 40) return now;
                before = now;
            }
        };
        const start = await still();
        const changes = {};
        for (const key of ["ArrowLeft", "ArrowUp", "KeyW", "KeyD", "KeyE", "Minus"]) {
            const before = await still();
            await page.keyboard.press(key);
            changes[key] = (await still()) !== before;
        }
        found.changes = changes;
        await page.keyboard.press("KeyN");
        found.place = await page.locator(".place").textContent();
        await page.keyboard.press("KeyF");
        found.flies = await page.getAttribute("[data-do=fly]", "aria-pressed");
        await page.keyboard.press("KeyR");
        for (let k = 0; k < 20 && !found.back; k++) found.back = (await still()) === start;
        // Two cameras make a path, saved as a file.
        for (const key of ["KeyN", "KeyK", "KeyN", "KeyK"]) await page.keyboard.press(key);
        await page.focus("[data-do=save-path]");
        const [saved] = await Promise.all([page.waitForEvent("download"), page.keyboard.press("Enter")]);
        found.path = readFileSync(await saved.path(), "utf8");
        await tabTo(() => document.activeElement.closest("thead") !== null);
        await page.keyboard.press("Tab");
        await page.keyboard.press("Enter");
        found.sorted = await page.getAttribute(".sortable th:nth-child(2)", "aria-sort");
        await tabTo(() => document.activeElement.matches(".sortable tbody button"));
        await page.keyboard.press("Enter");
        await page.keyboard.press("Shift+Tab");
        for (let k = 0; k < 30 && !(await page.evaluate(() => document.activeElement.matches("#view-shown input"))); k++) await page.keyboard.press("Shift+Tab");
        await page.keyboard.press("Home");
        found.cut = await page.evaluate(() => document.activeElement.parentElement.style.getPropertyValue("--cut"));
        // Listened for well before the key: a chooser that opens while its interception is being set up is lost.
        const chooser = new Promise((resolve) => page.once("filechooser", resolve));
        await page.goto(`${job.url}/new`);
        await tabTo(() => document.activeElement.matches("[data-pick]"));
        await page.keyboard.press("Enter");
        found.chooser = (await chooser).isMultiple();
        await tabTo(() => document.activeElement.id === "start", 200);
        await page.keyboard.press("Enter");
        found.complaint = await page.locator("#faults").textContent();
        return found;
    },

    /** A stage by form: a mesh placed in a picture, tried, and rendered. */
    async light() {
        const found = {};
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.waitForSelector("#light[data-ready=yes]");
        await shot(page, "light_form");
        const text = () => page.textContent(".stage-text");
        found.first = await text();
        await page.selectOption("#light-thing", "file");
        await page.setInputFiles("#light-mesh", job.mesh);
        await page.waitForFunction(() => document.querySelector(".stage-text").textContent.includes("thing.obj"));
        await page.selectOption("#light-light", "lamp");
        await page.check("[name=floor]");
        const box = await page.locator(".spot-picture").boundingBox();
        await page.mouse.click(box.x + 0.25 * box.width, box.y + 0.75 * box.height);
        await page.focus("#light-y");
        await page.keyboard.press("ArrowUp"); // the picture, by keys
        found.placed = await text();
        // Files that cannot be what they say are refused as they are sent.
        await page.setInputFiles("#light-sky", { name: "sky.hdr", mimeType: "", buffer: Buffer.from("no picture") });
        await page.focus("[data-do=preview]");
        await page.keyboard.press("Enter");
        await page.waitForSelector("#light .fault:not([hidden])");
        found.refused = await page.textContent("#light .fault");
        await page.setInputFiles("#light-sky", []);
        await page.click("[data-do=preview]");
        await page.waitForSelector("figure.preview:not([hidden])");
        found.took = await page.textContent(".light-state");
        found.preview = await page.evaluate(async () => {
            const image = document.querySelector("figure.preview img");
            await image.decode();
            return [image.naturalWidth, image.naturalHeight];
        });
        await shot(page, "light_preview");
        await page.click("#light summary");
        const [download] = await Promise.all([page.waitForEvent("download"), page.click("#light a[download]")]);
        found.saved = { name: download.suggestedFilename(), same: readFileSync(await download.path(), "utf8") === await text() };
        found.nameless = await nameless(page);
        await page.waitForFunction(() => document.querySelector(".light-estimate").textContent);
        found.estimate = await page.textContent(".light-estimate");
        await page.click("[data-do=views]");
        await page.waitForURL((url) => !url.pathname.endsWith(job.job));
        found.job = page.url().split("/").pop();
        await page.waitForSelector(".pictures img");
        found.pictures = await page.locator(".pictures img").evaluateAll((images) => Promise.all(images.map(async (image) => { image.loading = "eager"; await image.decode(); return image.naturalWidth; })));
        await shot(page, "light_result");
        found.left = await page.evaluate(() => fetch("/v1/jobs?label=preview of light").then((answer) => answer.json()).then(({ jobs }) => jobs.length));
        return found;
    },

    /** What lies behind the views of a result with materials, another light for it, and other materials. */
    async relight() {
        const found = {};
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.waitForSelector("#relight[data-ready=yes]");
        const decoded = (selector) => page.evaluate(async (one) => {
            const image = document.querySelector(one);
            image.loading = "eager";
            await image.decode();
            return [new URL(image.src).pathname.replace(/.*\/artifacts\//, ""), image.naturalWidth, image.naturalHeight];
        }, selector);
        found.learnt = await decoded(".learnt img");
        found.layers = [];
        for (const button of await page.locator("#view-shown .layers [data-layer]").all()) {
            await button.click();
            found.layers.push([await button.textContent(), ...await decoded("#view-shown .below")]);
            if (job.every) await shot(page, `materials_${await button.getAttribute("data-mode")}`, false);
        }
        await shot(page, "relight_form");
        found.tag = await page.textContent("#view-shown .tag.right");
        await page.locator(".sortable tbody tr").nth(1).click();
        found.other = await decoded("#view-shown .below"); // the layer stays, the view changes
        await page.click("#view-shown [data-mode=render]");
        found.render = await decoded("#view-shown .below");
        found.hidden = await page.evaluate(() => document.getElementById("relight-samples").parentElement.hidden);
        await page.click("#relight [data-do=views]");
        await page.waitForSelector("#relight .fault:not([hidden])");
        found.refused = await page.textContent("#relight .fault");
        await page.setInputFiles("#relight-file", job.map);
        await page.fill("#relight-rotation_degrees", "90");
        // The 3D view shows it at once; the learnt light is another.
        await page.waitForSelector("#viewer[data-ready=yes]");
        const look = async () => {
            await page.evaluate(() => scrollTo(0, 0));
            await page.waitForSelector("#viewer[data-rested=yes][data-drawn=all]");
            for (let before = NaN; ;) { // until what is on the screen stays as it is
                await page.waitForTimeout(300);
                const { mean } = await brightness(page);
                if (mean === before) return mean;
                before = mean;
            }
        };
        const looks = [await look()];
        for (const live of ["this", "learnt", ""]) {
            await page.selectOption("#relight-live", live);
            await page.waitForSelector(`#relight[data-live=${live || "none"}]`);
            looks.push(await look());
            if (job.every && live) await shot(page, `live_${live}`, false);
        }
        found.looks = looks;
        await page.selectOption("#relight-integrator", job.by);
        if (job.preview) {
            await page.click("#relight [data-do=preview]");
            await page.waitForSelector("#relight figure.preview:not([hidden])");
            found.preview = await decoded("#relight .preview img");
            found.took = await page.textContent("#relight .light-state");
            await shot(page, "relight_preview");
        }
        found.nameless = await nameless(page);
        const wide = page.viewportSize();
        await page.setViewportSize({ width: 360, height: 760 });
        await page.evaluate(() => document.querySelectorAll("details").forEach((fold) => { fold.open = true; }));
        await page.waitForTimeout(400);
        found.overflow = await overflow(page);
        await shot(page, "relight_phone");
        await page.setViewportSize(wide);
        await page.click("#relight [data-do=views]");
        await page.waitForURL((url) => !url.pathname.endsWith(job.job));
        found.first = page.url().split("/").pop();
        if (job.preview) {
            await page.waitForSelector(".pictures img");
            await shot(page, "relight_result");
        }
        // What was sent before can be chosen.
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.waitForSelector("#relight[data-ready=yes]");
        found.maps = await page.locator("#relight-map option").allTextContents();
        await page.selectOption("#relight-map", { index: 1 });
        await page.check("#relight [name=spin]");
        await page.click("#relight [data-do=turntable]");
        await page.waitForURL((url) => !url.pathname.endsWith(job.job));
        found.second = page.url().split("/").pop();
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.click("form[data-kind=material] >> xpath=ancestor::details >> summary");
        await page.fill("#material-set-albedo", "#ff8000");
        await page.fill("#material-multiply-roughness", "0.5");
        await page.fill("#material-where", "metallic > 0.5");
        await shot(page, "material_form");
        await page.click("form[data-kind=material] [type=submit]");
        await page.waitForURL((url) => !url.pathname.endsWith(job.job));
        found.third = page.url().split("/").pop();
        return found;
    },

    /** All pages as narrow as a phone, in dark and light, and by touch. */
    async phone() {
        const found = { overflow: {}, background: {} };
        for (const colorScheme of ["light", "dark"]) {
            const page = await open({ width: 360, height: 760, colorScheme, hasTouch: true, isMobile: true, deviceScaleFactor: 2 });
            for (const [name, path] of Object.entries({ jobs: "/", job: `/jobs/${job.job}`, new: "/new", sign_in: "/sign-in", missing: "/jobs/00000000-0000-7000-8000-000000000000" })) {
                await page.goto(job.url + path);
                if (name === "job" && colorScheme === "light") await page.waitForSelector("#viewer[data-ready=yes]");
                await page.evaluate(() => document.querySelectorAll("details").forEach((fold) => { fold.open = true; }));
                await page.waitForTimeout(400);
                found.overflow[`${name} ${colorScheme}`] = await overflow(page);
                found.background[`${name} ${colorScheme}`] = await page.evaluate(() => getComputedStyle(document.body).backgroundColor);
                await shot(page, `phone_${name}_${colorScheme}`);
                if (name !== "job" || colorScheme !== "light") continue;
                const canvas = page.locator("#viewer canvas:not(.overlay)"), box = await canvas.boundingBox();
                const before = (await canvas.screenshot()).toString("base64");
                const touch = await page.context().newCDPSession(page);
                await canvas.scrollIntoViewIfNeeded();
                const at = await canvas.boundingBox();
                const point = (dx) => [{ x: at.x + at.width / 2 + dx, y: at.y + at.height / 2 }];
                await touch.send("Input.dispatchTouchEvent", { type: "touchStart", touchPoints: point(0) });
                for (let dx = 10; dx <= 90; dx += 10) await touch.send("Input.dispatchTouchEvent", { type: "touchMove", touchPoints: point(dx) });
                await touch.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
                for (let k = 0; k < 30 && !found.touchTurns; k++) {
                    await page.waitForTimeout(200);
                    found.touchTurns = box !== null && (await canvas.screenshot()).toString("base64") !== before;
                }
            }
            await page.context().close();
        }
        return found;
    },

    /** Where a token is needed: asked for, refused, taken, forgotten. */
    async signIn() {
        const page = await open({ signedIn: false });
        await page.goto(`${job.url}/new`);
        const found = { sentTo: new URL(page.url()).pathname + new URL(page.url()).search };
        await page.fill("#token", "octa_wrong");
        await page.keyboard.press("Enter");
        await page.waitForSelector("#refused");
        found.refused = await page.locator("#refused").textContent();
        await shot(page, "sign_in");
        await page.fill("#token", job.token);
        await page.keyboard.press("Enter");
        await page.waitForURL("**/new");
        const [cookie] = await page.context().cookies();
        found.cookie = { httpOnly: cookie.httpOnly, sameSite: cookie.sameSite };
        found.readable = await page.evaluate(() => document.cookie);
        found.api = await page.evaluate(() => fetch("/v1/info").then((answer) => answer.json()).then((info) => info.owner));
        await page.click("text=Sign out");
        await page.waitForURL("**/sign-in");
        found.after = await page.evaluate(() => fetch("/v1/info").then((answer) => answer.status));
        return found;
    },

    /** Buttons of the list and of a job's page: cancel, retry, keep, delete; events do not come through. */
    async actions() {
        const found = {};
        const page = await open();
        await page.route("**/events**", (route) => route.abort("connectionfailed"));
        await page.goto(`${job.url}/`);
        await page.click(`#cancel-${job.jobs[0]}`);
        await page.waitForSelector(`#job-${job.jobs[0]} .chip.canceled`);
        await page.click(`#retry-${job.jobs[0]}`);
        await page.waitForSelector(`#job-${job.jobs[0]} .chip.queued`);
        await page.goto(`${job.url}/jobs/${job.jobs[1]}`);
        await page.click("#do-cancel");
        await page.waitForSelector("#do-retry");
        await page.click("#do-pin");
        await page.waitForSelector("#do-pin[aria-pressed=true]");
        // A click that comes before the modules are there is asked about, too.
        await page.route("**/static/app.js", async (route) => { await new Promise((done) => setTimeout(done, 3000)); await route.continue().catch(() => {}); });
        await page.reload({ waitUntil: "commit" });
        page.once("dialog", (dialog) => { found.asked = dialog.message(); dialog.accept(); });
        await page.click("#do-delete");
        await page.waitForURL(`${job.url}/`);
        found.gone = await page.locator(`#job-${job.jobs[1]}`).count() === 0;
        await page.goto(`${job.url}/jobs/${job.jobs[0]}`);
        await page.waitForTimeout(200);
        await page.evaluate((address) => fetch(address, { method: "POST" }), `/v1/jobs/${job.jobs[0]}/cancel`);
        await page.waitForSelector("#status[data-state=canceled]");
        found.polled = true;
        return found;
    },

    /** Notes in a 3D view, some of which were written after the page was loaded. */
    async notes() {
        const page = await open();
        await page.goto(`${job.url}/jobs/${job.job}`);
        await page.waitForSelector("#viewer .view-notes li");
        await page.evaluate(({ address, notes }) => fetch(address, { method: "PATCH", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ view_notes: notes }) }), { address: `/v1/jobs/${job.job}`, notes: job.notes });
        await page.click("#viewer .view-notes li:first-child [aria-label^=Remove]");
        await page.waitForFunction((text) => !document.querySelector("#viewer .view-notes").textContent.includes(text), job.notes[0].text);
        return { shown: await page.locator("#viewer .view-notes li button:first-child").allTextContents() };
    },

    /** The log of a job, one request of which the service could not answer. */
    async log() {
        const page = await open();
        const asked = [];
        await page.route("**/logs?*", (route) => {
            asked.push(new URL(route.request().url()).searchParams.get("after"));
            if (asked.length > 1) return route.continue();
            return route.fulfill({ status: 503, contentType: "application/problem+json", body: '{"title": "busy"}' });
        });
        await page.goto(`${job.url}/jobs/${job.job}`);
        if (!await page.evaluate(() => document.getElementById("log-fold").open)) await page.click("#log-fold summary");
        await page.waitForFunction(() => document.getElementById("log").textContent.includes("a line"), undefined, { timeout: 30000 });
        // Folded and opened again, it goes on where it was.
        await page.click("#log-fold summary");
        await page.click("#log-fold summary");
        await page.waitForTimeout(3000);
        return { asked, lines: await page.evaluate(() => document.getElementById("log").textContent.split("a line").length - 1) };
    },
};

/** Takes the steps that a job names. */
export async function run(given, started) {
    [job, browser, complaints] = [given, started, []];
    return { ...await steps[job.name](), complaints };
}
