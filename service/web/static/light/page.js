// The form of a stage on a finished job's page: what it says becomes a stage, which is shown, tried and rendered.

import { answer, queueJob } from "../options.js";
import { Upload } from "../upload.js";
import { meshExtent } from "./mesh_extent.js";
import { stageText } from "./stage_text.js";

const PREVIEW = { samples: 4, side: 320 };
const LOOK_MS = 300;
const TURN = { frames: 96, width_px: 640, height_px: 480 };

const PAUSE_MS = 500;
const WHAT = { views: { mode: "views", format: "png" }, turntable: { mode: "turntable", ...TURN } };

const section = document.getElementById("light");
const form = section.querySelector("form");
const find = (selector) => section.querySelector(selector);
const { job: source, queue, priority } = section.dataset;
const picture = find(".spot-picture"), spot = find(".spot"), fault = find(".fault"), state = find(".light-state");
let cameras = null, extent = 1, text = "", link = null;
let sent = { key: "", id: null }; // the files that were sent last
let trial = null; // the preview under way
let asking = 0, latest = 0; // for estimates

const say = (words) => { state.textContent = words; };
const chosen = () => form.elements.view.selectedOptions[0];

function complain(words) {
    fault.textContent = words;
    fault.hidden = !words;
}

function values() {
    const found = { mesh: fileName("mesh"), sky: fileName("sky") };
    for (const { name, type, value, checked } of form.elements) {
        if (!name || type === "file") continue;
        found[name] = type === "checkbox" ? checked : type === "range" || type === "number" ? Number(value) : value;
    }
    return found;
}

/** What a file is called in the stage: plain letters, which every system takes. */
function fileName(field) {
    const file = form.elements[field].files[0];
    if (!file) return null;
    const clean = file.name.replace(/[^A-Za-z0-9._-]+/g, "_").replace(/^[._-]+/, "").slice(-80);
    return clean.replace(/\.[^.]*$/, (suffix) => suffix.toLowerCase()) || field;
}

function stage(samples) {
    const given = values(), view = chosen();
    const camera = cameras.views.find(({ name }) => name === view.value) ?? cameras.views[0];
    const at = { view: view.value, x: given.x / 100 * view.dataset.width, y: given.y / 100 * view.dataset.height };
    return stageText({ ...given, samples: samples ?? given.samples }, { ...cameras, forward: camera.forward }, at, extent);
}

/** Whether a field counts: `name=value value`, or `name=*` for any. */
function isNeeded(needs, given) {
    const [name, wanted] = needs.split("=");
    if (name === "material" && given.thing === "none") return false;
    return wanted === "*" ? Boolean(given[name]) : wanted.split(" ").includes(String(given[name]));
}

function show() {
    for (const output of form.querySelectorAll("output")) output.textContent = `${output.htmlFor.value && document.getElementById(output.htmlFor.value).value}${output.dataset.unit}`;
    const given = values(), { x, y } = given;
    for (const field of form.querySelectorAll("[data-needs]")) field.hidden = !isNeeded(field.dataset.needs, given);
    spot.style.left = `${x}%`;
    spot.style.top = `${y}%`;
    if (!cameras) return;
    text = stage();
    find(".stage-text").textContent = text;
    if (link) URL.revokeObjectURL(link);
    link = URL.createObjectURL(new Blob([text], { type: "application/toml" }));
    find("a[download]").href = link;
    clearTimeout(asking);
    asking = setTimeout(showEstimates, PAUSE_MS);
}

/** What the renders would take, or why the service does not take them. */
async function showEstimates() {
    const number = ++latest, headers = { "Content-Type": "application/json" };
    const [views, turntable] = await Promise.all(Object.values(WHAT).map(async (options) => {
        const body = { kind: "render", source_id: source, queue, options: { ...options, stage: text } };
        const response = await fetch("/v1/estimates", { method: "POST", headers, body: JSON.stringify(body) }).catch(() => null);
        const told = await response?.json().catch(() => null);
        return told?.estimate?.text ?? told?.errors?.[0]?.detail ?? "";
    }));
    if (number === latest && views) find(".light-estimate").textContent = `With 100,000 Gaussians the held-out views would take at most ${views}, a turntable of ${TURN.frames} frames ${turntable}; fewer are faster.`;
}

/** The files of the stage as a dataset, sent once; null where it names none. */
async function sendFiles() {
    const { thing, mesh, sky } = values();
    const files = [];
    if (thing === "file" && !mesh) throw new Error("Choose a mesh, or another shape.");
    if (thing === "file") files.push({ name: mesh, file: form.elements.mesh.files[0] });
    if (sky) files.push({ name: sky, file: form.elements.sky.files[0] });
    const key = files.map(({ name, file }) => `${name} ${file.size} ${file.lastModified}`).join("\n");
    if (key !== sent.key) {
        const largest = Number(section.dataset.maxFile), large = files.find(({ file }) => file.size > largest);
        if (large) throw new Error(`${large.name} is larger than the service takes.`);
        say("Sending the files …");
        const scene = { files, bytes: files.reduce((sum, { file }) => sum + file.size, 0) };
        sent = { key, id: files.length ? (await new Upload(scene, "stage", () => {}, "files").run()).id : null };
    }
    return sent.id;
}

async function queueRender(options, more = {}) {
    const files = await sendFiles();
    const body = { kind: "render", source_id: source, queue, ...(files ? { files_id: files } : {}), options, ...more };
    return queueJob(body, crypto.randomUUID?.() ?? String(Math.random()));
}

/** What went wrong, each sentence once. */
const sentences = (error) => [...new Set([error.message, ...(error.faults ?? [])])].join(" ");
const api = (path, method = "GET") => fetch(`/v1/jobs/${path}`, { method });

/** One small picture with few samples; the job goes when its picture is here. */
async function preview() {
    const mine = trial = { id: null };
    const view = chosen(), began = performance.now();
    complain("");
    say("Asking for a preview …");
    section.setAttribute("aria-busy", "true");
    try {
        mine.id = await queueRender(
            { mode: "views", photographs: [view.value], format: "png", max_side: PREVIEW.side, stage: stage(PREVIEW.samples) },
            { priority: Number(priority), label: "preview of light" },
        );
        const job = await finished(mine);
        if (job) await showPicture(mine.id, view.value, Math.round((performance.now() - began) / 1000));
    } catch (error) {
        if (mine === trial) {
            say("");
            complain(sentences(error));
        }
    } finally {
        if (mine.id) forget(mine.id);
        if (mine === trial) section.removeAttribute("aria-busy");
    }
}

/** Deletes a job that nobody needs any more, stopped first if it is not over. */
async function forget(id) {
    for (let tries = 0; tries < 10; tries++) {
        const gone = await api(`${id}?cancel=true`, "DELETE").catch(() => null);
        if (gone && gone.status !== 409) return;
        await new Promise((resolve) => setTimeout(resolve, 2000));
    }
}

/** Waits for a job; null if another preview was asked for meanwhile. */
async function finished(mine) {
    for (;;) {
        if (mine !== trial) return null;
        const job = await api(mine.id).then(answer);
        if (job.state === "succeeded") return job;
        if (job.state === "failed") throw new Error(job.error.message);
        if (job.state === "canceled") throw new Error("The preview was cancelled.");
        if (job.state === "running") say("Rendering a preview …");
        else say(job.notes[0] ?? (job.queue_position ? `Waiting: ${job.queue_position} before it.` : "Waiting for a worker …"));
        await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
    }
}

async function showPicture(id, name, seconds) {
    const { artifacts } = await api(`${id}/artifacts`).then(answer);
    const found = artifacts.find((artifact) => artifact.name.endsWith(".png"));
    const content = await (await api(`${id}/artifacts/${found.name.split("/").map(encodeURIComponent).join("/")}`)).blob();
    const figure = find("figure.preview"), image = figure.querySelector("img");
    if (image.src) URL.revokeObjectURL(image.src);
    image.src = URL.createObjectURL(content);
    image.alt = `Preview of ${name} with the stage`;
    figure.querySelector("figcaption").textContent = `${name}, ${PREVIEW.samples} samples a pixel; a render has no such grain.`;
    figure.hidden = false;
    say(`The preview took ${seconds} s.`);
}

async function render(options, button) {
    complain("");
    button.disabled = true;
    try {
        const id = await queueRender({ ...options, stage: stage() });
        location.href = `/jobs/${id}`;
    } catch (error) {
        say("");
        complain(sentences(error));
        button.disabled = false;
    }
}

function place(x, y) {
    const percent = (value) => String(Math.round(Math.min(1, Math.max(0, value)) * 200) / 2);
    form.elements.x.value = percent(x);
    form.elements.y.value = percent(y);
    show();
}

picture.addEventListener("click", (event) => {
    const box = picture.getBoundingClientRect();
    place((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
});
form.elements.view.addEventListener("change", () => {
    picture.src = chosen().dataset.render;
    picture.alt = `The scene as ${chosen().value} sees it`;
});
async function takeMesh() {
    const file = form.elements.mesh.files[0];
    extent = file ? await meshExtent(file) : 1;
    show();
}
form.elements.mesh.addEventListener("change", takeMesh);
for (const kind of ["dragover", "drop"]) {
    find(".spot-box").addEventListener(kind, (event) => {
        if (![...event.dataTransfer.types].includes("Files")) return;
        event.preventDefault();
        if (kind === "dragover") return;
        const file = event.dataTransfer.files[0], field = /\.(hdr|exr)$/i.test(file.name) ? "sky" : "mesh";
        const box = picture.getBoundingClientRect();
        form.elements[field].files = event.dataTransfer.files;
        if (field === "mesh") {
            form.elements.thing.value = "file";
            place((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
            takeMesh();
        } else show();
    });
}
form.addEventListener("input", show);
form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (cameras) preview();
});
find("[data-do=views]").addEventListener("click", ({ target }) => render(WHAT.views, target));
find("[data-do=turntable]").addEventListener("click", ({ target }) => render(WHAT.turntable, target));

show();
const buttons = form.querySelectorAll("[data-do]");
buttons.forEach((button) => { button.disabled = true; });
fetch(section.dataset.cameras).then(answer).then((found) => {
    if (!found.views.length) throw new Error("The cameras of this scene cannot be read.");
    cameras = found;
    buttons.forEach((button) => { button.disabled = false; });
    show();
    section.dataset.ready = "yes";
}).catch((error) => complain(error.message));
