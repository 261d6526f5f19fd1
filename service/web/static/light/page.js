// The form of a stage on a finished job's page: what it says becomes a stage, which is shown, tried and rendered.

import { plainName } from "../file_names.js";
import { SentFiles, fieldValues, holds, showFields } from "../form_parts.js";
import { answer, queueJob } from "../options.js";
import { Trials, sentences } from "../trial.js";
import { meshExtent } from "./mesh_extent.js";
import { stageText } from "./stage_text.js";

const PREVIEW = { samples: 4, side: 320 };
const TURN = { frames: 96, width_px: 640, height_px: 480 };

const PAUSE_MS = 500;
const WHAT = { views: { mode: "views", format: "png" }, turntable: { mode: "turntable", ...TURN } };

const section = document.getElementById("light");
const form = section.querySelector("form");
const find = (selector) => section.querySelector(selector);
const { job: source, queue, priority } = section.dataset;
const picture = find(".spot-picture"), spot = find(".spot");
const trials = new Trials(section);
const sent = new SentFiles("stage", Number(section.dataset.maxFile), (words) => trials.say(words));
let cameras = null, extent = 1, text = "", link = null;
let measured = Promise.resolve(); // once the extent is that of the mesh
let asking = 0, latest = 0; // for estimates

const chosen = () => form.elements.view.selectedOptions[0];

function values() {
    return { mesh: fileName("mesh"), sky: fileName("sky"), ...fieldValues(form) };
}

/** What a file is called in the stage. */
const fileName = (field) => plainName(form.elements[field].files[0], field);

function stage(samples) {
    const given = values(), view = chosen();
    const camera = cameras.views.find(({ name }) => name === view.value) ?? cameras.views[0];
    const at = { view: view.value, x: given.x / 100 * view.dataset.width, y: given.y / 100 * view.dataset.height };
    return stageText({ ...given, samples: samples ?? given.samples }, { ...cameras, forward: camera.forward }, at, extent);
}

function show() {
    const given = values(), { x, y } = given;
    showFields(form, (needs) => holds(needs, given) && !(needs.startsWith("material=") && given.thing === "none"));
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
        return await response?.json().catch(() => null);
    }));
    if (number !== latest) return;
    const fault = [views, turntable].map((told) => told?.errors?.[0]?.detail ?? "").find(Boolean) ?? "";
    find(".light-estimate").textContent = views?.estimate && turntable?.estimate
        ? `With 100,000 Gaussians the held-out views would take at most ${views.estimate.text}, a turntable of ${TURN.frames} frames ${turntable.estimate.text}; fewer are faster.`
        : fault;
}

/** Options with the stage, once it is known how large the mesh is. */
async function staged(options, samples) {
    for (let waited = null; waited !== measured;) await (waited = measured);
    return { ...options, stage: stage(samples) };
}

/** The files of the stage as a dataset, sent once; null where it names none. */
async function sendFiles() {
    const { thing, mesh, sky } = values();
    const files = [];
    if (thing === "file" && !mesh) throw new Error("Choose a mesh, or another shape.");
    if (thing === "file") files.push({ name: mesh, file: form.elements.mesh.files[0] });
    if (sky) files.push({ name: sky, file: form.elements.sky.files[0] });
    return sent.dataset(files);
}

async function queueRender(options, more = {}) {
    const files = await sendFiles();
    const body = { kind: "render", source_id: source, queue, ...(files ? { files_id: files } : {}), options, ...more };
    return queueJob(body, crypto.randomUUID?.() ?? String(Math.random()));
}

/** One small picture with few samples. */
function preview() {
    const view = chosen().value;
    const options = { mode: "views", photographs: [view], format: "png", max_side: PREVIEW.side };
    const about = `${PREVIEW.samples} samples a pixel; a render has no such grain.`;
    trials.show(async () => queueRender(await staged(options, PREVIEW.samples), { priority: Number(priority), label: "preview of light" }), view, "with the stage", about);
}

async function render(options, button) {
    trials.complain("");
    button.disabled = true;
    try {
        const id = await queueRender(await staged(options));
        location.href = `/jobs/${id}`;
    } catch (error) {
        trials.say("");
        trials.complain(sentences(error));
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
function takeMesh() {
    const file = form.elements.mesh.files[0];
    const reading = file ? meshExtent(file) : Promise.resolve(1);
    measured = reading.then((found) => {
        if (file !== form.elements.mesh.files[0]) return; // another one has been chosen since
        extent = found;
        show();
    });
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
}).catch((error) => trials.complain(error.message));
