// A job's page: what happens arrives as events, or is asked for where they do not; curves, preview, log.

import { Charts, Training } from "./charts.js";
import { comparison } from "./compare.js";
import { duration, thousands } from "./numbers.js";
import "./table.js";
import "./job_forms.js";

const about = document.getElementById("about");
const api = `/v1/jobs/${about.dataset.job}`;
const isOver = (state) => ["succeeded", "failed", "canceled"].includes(state);
const status = () => document.getElementById("status");
const training = new Training();
const chartBox = document.getElementById("charts");
const charts = chartBox && new Charts(chartBox, training);
let heard = 0;
let drawing = 0;

function redraw() {
    if (charts && !drawing) drawing = setTimeout(() => { drawing = 0; charts.update(); }, 100);
}

function refresh() {
    document.body.dispatchEvent(new CustomEvent("job-news"));
}

/** Loads the page again, as it has other parts by now; not while something is written, which would be gone. */
function showAnew() {
    const isWritten = [...document.querySelectorAll("input[type=text], textarea")].some((field) => field.value !== field.defaultValue && field.checkVisibility());
    if (isWritten) setTimeout(showAnew, 1000);
    else location.reload();
}

function showPreview({ step, view }) {
    const box = document.getElementById("preview");
    if (!box) return;
    const address = `${api}/preview?step=${step}`;
    const below = box.querySelector(".below");
    if (below) below.src = address;
    else {
        const photographs = document.getElementById("training").dataset.photographs;
        const photograph = /\.(jpe?g|png|webp|bmp)$/i.test(view) ? `${photographs}images/${view.split("/").map(encodeURIComponent).join("/")}` : null;
        box.append(comparison(address, "Preview", photograph, "Photograph", view), Object.assign(document.createElement("p"), { className: "soft small caption" }));
        box.hidden = false;
    }
    box.querySelector(".caption").textContent = `${view} at step ${thousands(step)}`;
}

/** Another state of the training in the 3D view; see viewer/page.js. */
function showLiveScene({ step, gaussians }) {
    const count = step ? `Step ${thousands(step)}, ${thousands(gaussians)} Gaussians` : `${thousands(gaussians)} sparse points`;
    document.getElementById("viewer")?.dispatchEvent(new CustomEvent("scene", { detail: { scene: `${api}/live-scene?step=${step}`, count } }));
}

function showProgress(event) {
    const section = status();
    const bar = section?.querySelector("progress"), text = section?.querySelector(".bar-text");
    const step = event.iteration ?? event.step, total = event.total_iterations ?? event.total_steps;
    if (!bar || !text || !total) return;
    bar.max = total;
    bar.value = step;
    // that of a training holds the fit of residual colors, which is a stage of its own
    const left = event.seconds_left == null ? "" : ` · ${duration(event.seconds_left - (event.seconds_after ?? 0))} left`;
    const name = text.querySelector("b");
    if (event.stage && name) name.textContent = event.stage.replaceAll("_", " ");
    if (name) text.replaceChildren(name, ` ${thousands(step)}/${thousands(total)}${left}`);
    showDecibels("live-training-psnr", event.training_psnr);
    if (event.gaussians != null) document.getElementById("live-gaussians")?.replaceChildren(thousands(event.gaussians));
}

function showDecibels(id, value) {
    if (value != null) document.getElementById(id)?.replaceChildren(value.toFixed(2), Object.assign(document.createElement("small"), { textContent: " dB" }));
}

/** Takes an event; `isNew` is false while the past is read. */
function hear(kind, data, id, isNew) {
    heard = Math.max(heard, id);
    if (kind === "progress") {
        if (training.add(data)) redraw();
        if (isNew) showProgress(data);
    } else if (kind === "held_out_measured") {
        if (training.addHeldOut(data)) redraw();
        if (isNew) showDecibels("live-psnr", data.psnr);
    } else if (kind === "preview" && isNew && data.view) showPreview(data); // without a view it is a map of blocks
    else if (kind === "live_scene" && isNew) showLiveScene(data);
    else if (kind === "state" && isNew && isOver(data.state)) showAnew();
    else if (isNew) refresh();
}

async function readPast() {
    const limit = 5000;
    for (;;) {
        const response = await fetch(`${api}/timeline?after=${heard}&limit=${limit}`);
        if (!response.ok) throw new Error(String(response.status));
        const { events } = await response.json();
        events.forEach(({ id, kind, data }) => hear(kind, data, id, false));
        if (events.length < limit) return;
    }
}

const KINDS = ["progress", "preview", "state", "stage_started", "stage_finished", "held_out_measured", "warning", "live_scene", "checkpoint", "rescued", "handed_back", "resumed", "stages", "blocks_queued", "block_finished", "run_finished"];

function listen() {
    let failures = 0;
    const source = new EventSource(`${api}/events?after=${heard}`);
    for (const kind of KINDS) {
        source.addEventListener(kind, (event) => {
            failures = 0;
            hear(kind, JSON.parse(event.data), Number(event.lastEventId), true);
        });
    }
    source.onerror = () => {
        failures += 1;
        if (source.readyState === EventSource.CLOSED || failures > 3) {
            source.close();
            poll();
        }
    };
}

/** Where streams do not come through, asking every other second does. */
async function poll() {
    for (;;) {
        await new Promise((resolve) => setTimeout(resolve, 2000));
        if (document.hidden) continue;
        try {
            const response = await fetch(`${api}/timeline?after=${heard}`);
            if (response.status === 404 || response.status === 401) return;
            const { events } = await response.json();
            events.forEach(({ id, kind, data }) => hear(kind, data, id, true));
        } catch { /* it will answer again */ }
        if (isOver(status()?.dataset.state)) return;
    }
}

const MAX_LINES = 3000;

async function followLog() {
    const log = document.getElementById("log"), fold = document.getElementById("log-fold");
    let after = 0;
    for (;;) {
        if (fold.open && !document.hidden) {
            try {
                const response = await fetch(`${api}/logs?after=${after}&limit=2000`);
                if (!response.ok) throw new Error(String(response.status));
                const page = await response.json();
                after = page.next;
                const atEnd = log.scrollTop + log.clientHeight >= log.scrollHeight - 30;
                log.append(...page.lines.map(({ text, at }) => document.createTextNode(`${new Date(at).toLocaleTimeString("en-GB")}  ${text}\n`)));
                while (log.childNodes.length > MAX_LINES) log.firstChild.remove();
                if (page.lines.length && atEnd) log.scrollTop = log.scrollHeight;
                if (page.lines.length === 2000) continue;
                if (isOver(about.dataset.state)) return;
            } catch { /* it will answer again */ }
        }
        await new Promise((resolve) => setTimeout(resolve, 2000));
    }
}

document.addEventListener("job-changed", ({ detail }) => {
    // A retried job has a life ahead of it again.
    if (isOver(about.dataset.state) !== isOver(detail.state)) showAnew();
});
const logFold = document.getElementById("log-fold");
if (logFold.open) followLog();
else logFold.addEventListener("toggle", followLog, { once: true });
readPast().catch(() => {}).then(() => {
    charts?.update();
    if (!isOver(about.dataset.state)) listen();
    else if (charts && training.iterations.length < 2) chartBox.querySelector(".empty")?.replaceChildren("There are no curves.");
});
