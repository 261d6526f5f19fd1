// The form of another light on the page of a finished job with materials.

import { plainName } from "../file_names.js";
import { SentFiles, fieldValues, holds, showFields } from "../form_parts.js";
import { answer, queueJob } from "../options.js";
import { Trials, sentences } from "../trial.js";
import { readHdr } from "../viewer/environment.js";

const PREVIEW = { samples: { "split-sum": 1, path: 4 }, side: 320 };
const WHAT = {
    views: { mode: "views", format: "png" },
    turntable: { mode: "turntable", frames: 96, width_px: 640, height_px: 480 },
};

const section = document.getElementById("relight");
const form = section.querySelector("form");
const { job: source, queue, priority } = section.dataset;
const trials = new Trials(section);
const sent = new SentFiles("light", Number(section.dataset.maxFile), (words) => trials.say(words));

/** The map that is meant: its dataset, and its name there. */
async function light() {
    const { map } = fieldValues(form);
    if (map) return { files_id: map.slice(0, map.indexOf("/")), name: map.slice(map.indexOf("/") + 1) };
    const file = form.elements.file.files[0];
    if (!file) throw new Error("Choose a file of light: HDR or EXR.");
    const name = plainName(file, "light.hdr");
    return { files_id: await sent.dataset([{ name, file }]), name };
}

/** The options that the form asks for. */
function asked() {
    const { rotation_degrees, spin, integrator, samples, background } = fieldValues(form);
    return { rotation_degrees, spin, integrator, ...(integrator === "path" ? { samples: Number(samples) } : {}), ...(background ? { background } : {}) };
}

async function queueRelight(options, more = {}) {
    const { files_id, name } = await light();
    const body = { kind: "relight", source_id: source, queue, files_id, options: { ...asked(), ...options, environments: [name] }, ...more };
    return queueJob(body, crypto.randomUUID?.() ?? String(Math.random()));
}

function preview() {
    const view = form.elements.view.value, { integrator } = fieldValues(form), samples = PREVIEW.samples[integrator];
    const options = { mode: "views", photographs: [view], format: "png", max_side: PREVIEW.side, samples };
    const about = integrator === "path" ? `${samples} paths a pixel; more have less grain.` : `${samples} ray a pixel; a render has smoother edges.`;
    trials.show(() => queueRelight(options, { priority: Number(priority), label: "preview of another light" }), view, "in another light", about);
}

async function render(options, button) {
    trials.complain("");
    button.disabled = true;
    try {
        location.href = `/jobs/${await queueRelight(options)}`;
    } catch (error) {
        trials.say("");
        trials.complain(sentences(error));
        button.disabled = false;
    }
}

/** The file of the map that the 3D view is to show. */
async function liveFile() {
    const { live, map } = fieldValues(form);
    if (live === "this" && !map) {
        const file = form.elements.file.files[0];
        if (!file) throw new Error("Choose a file of light: HDR.");
        return file.arrayBuffer();
    }
    const path = map.slice(map.indexOf("/") + 1).split("/").map(encodeURIComponent).join("/");
    const address = live === "learnt" ? section.dataset.learnt : `/v1/datasets/${map.slice(0, map.indexOf("/"))}/files/${path}`;
    const response = await fetch(address);
    if (!response.ok) await answer(response);
    return response.arrayBuffer();
}

let newest = 0; // light that was chosen; that of one before may still be on its way
let isLoading = false;

/** Shows the light in the 3D view. */
async function showLive() {
    const number = ++newest, { live } = fieldValues(form);
    trials.complain("");
    isLoading = true;
    try {
        const map = live ? readHdr(await liveFile()) : null;
        if (number !== newest) return;
        isLoading = false;
        turnLive(map);
        section.dataset.live = live || "none";
    } catch (error) {
        if (number !== newest) return;
        isLoading = false;
        form.elements.live.value = "";
        section.dataset.live = "none";
        viewer.dispatchEvent(new CustomEvent("light", { detail: { map: null, degrees: 0 } }));
        trials.complain(sentences(error));
    }
}

/** Turns the light in the 3D view as the form says by now, or shows another one. */
function turnLive(map) {
    const { live, rotation_degrees } = fieldValues(form);
    const lit = live === "this" ? "other" : live || "none";
    viewer.dispatchEvent(new CustomEvent("light", { detail: { map, degrees: live === "this" ? rotation_degrees : 0, lit } }));
}

/** Says what the 3D view shows by itself, or by its own button. */
function followLive() {
    const { lit } = viewer.dataset;
    if (isLoading || !lit || lit === "other") return;
    form.elements.live.value = lit === "learnt" ? "learnt" : "";
    section.dataset.live = form.elements.live.value || "none";
}

const viewer = document.getElementById("viewer");
const offerLive = () => { form.elements.live.closest(".field").hidden = false; };
if (viewer?.dataset.materials) offerLive();
else viewer?.addEventListener("materials", offerLive);
viewer?.addEventListener("lit", followLive);
if (viewer) followLive();
form.elements.live.addEventListener("change", showLive);
for (const name of ["map", "file"]) form.elements[name].addEventListener("change", () => { if (form.elements.live.value === "this") showLive(); });
form.elements.rotation_degrees.addEventListener("input", () => { if (section.dataset.live === "this") turnLive(); });

const show = () => showFields(form, (needs) => holds(needs, fieldValues(form)));
form.addEventListener("input", show);
form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (form.elements.view) preview();
});
for (const [name, options] of Object.entries(WHAT)) section.querySelector(`[data-do=${name}]`)?.addEventListener("click", ({ target }) => render(options, target));
show();
section.dataset.ready = "yes";
