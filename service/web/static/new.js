// The page of a new job: photographs are chosen or dropped, sent, and their reconstruction is queued.

import { showEstimates } from "./estimate.js";
import { shortName } from "./file_names.js";
import { fillOptions, followPreset, queueJob, readOptions } from "./options.js";
import { chosenFiles, droppedFiles, scenesOf } from "./scene_files.js";
import { Upload } from "./upload.js";
import { thousands } from "./numbers.js";

const form = document.getElementById("new-job");
const find = (id) => document.getElementById(id);
const drop = find("drop"), known = find("dataset"), start = find("start"), pause = find("pause"), faults = find("faults");
let scenes = null, upload = null, choice = 0; // several scenes become a job each
let isStarting = false; // what was chosen is being sent, and nothing else can be chosen

// By their attributes: a field of the form has the id "dataset".
const kind = form.getAttribute("data-kind"), given = form.getAttribute("data-given");
if (given) fillOptions(form, JSON.parse(given));
const region = new URLSearchParams(location.hash.slice(1)).get("region"); // a box from the 3D view of another job
if (region) {
    const field = form.querySelector("[data-path=region]");
    field.value = region.replaceAll(",", " ");
    for (let fold = field.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
}
followPreset(form);
const estimateAnew = showEstimates(form, find("estimate"), () => ({ scene: largest(), dataset: known?.value, queue: find("queue")?.value ?? "cpu" }));

/** The chosen scene, of several the one that takes the longest. */
function largest() {
    return scenes && scenes.reduce((one, other) => (other.photographs > one.photographs ? other : one));
}

function size(bytes) {
    const units = ["B", "kB", "MB", "GB", "TB"];
    let unit = 0;
    while (bytes >= 999.5 && unit < units.length - 1) [bytes, unit] = [bytes / 1000, unit + 1];
    return `${bytes.toFixed(unit && bytes < 99.5 ? 1 : 0)} ${units[unit]}`;
}

function complain(text, sentences = []) {
    faults.replaceChildren(text);
    if (sentences.length) {
        const list = document.createElement("ul");
        list.append(...sentences.slice(0, 20).map((sentence) => Object.assign(document.createElement("li"), { textContent: sentence })));
        if (sentences.length > 20) list.append(Object.assign(document.createElement("li"), { textContent: `and ${sentences.length - 20} more` }));
        faults.append(list);
    }
    faults.hidden = false;
    faults.focus();
}

/** Takes files, or the promise of them, unless others are chosen meanwhile. */
async function choose(found) {
    if (isStarting) return;
    faults.hidden = true;
    const number = ++choice;
    start.disabled = true;
    try {
        const chosen = await scenesOf(await found);
        if (number !== choice) return; // others have been chosen since
        scenes = chosen;
    } catch (error) {
        if (number !== choice) return;
        scenes = null;
        show();
        complain(error.faults ? "This cannot be used as it is:" : error.message, error.faults);
        return;
    } finally {
        if (number === choice) start.disabled = false;
    }
    if (known) known.value = "";
    show();
    find("chosen-text").focus();
}

function describe(scene) {
    const what = `${scene.archive ? `${scene.archive.name}, ` : ""}${thousands(scene.photographs)} photographs${scene.posed ? " and a COLMAP model" : ""}`;
    return `${scene.title && !scene.archive ? `${scene.title}: ` : ""}${what}, ${size(scene.bytes)}`;
}

/** Shows what was chosen, and what the button will do. */
function show() {
    drop.hidden = scenes !== null;
    find("chosen").hidden = scenes === null;
    const notes = find("chosen-notes");
    notes.replaceChildren();
    if (scenes) {
        const add = (text) => notes.append(Object.assign(document.createElement("li"), { textContent: text }));
        const only = scenes.length === 1 ? scenes[0] : null;
        find("chosen-text").textContent = only ? describe(only) : `${scenes.length} scenes, a job each, ${size(scenes.reduce((sum, { bytes }) => sum + bytes, 0))}`;
        for (const scene of scenes) {
            if (!only) add(describe(scene));
            if (!scene.posed) add("There is no COLMAP model, so the poses are found first; that takes a while.");
            scene.notes.forEach(add);
        }
        find("label").placeholder = only?.title || "as the folder";
    }
    start.textContent = known?.value && !scenes ? "Start" : scenes?.length > 1 ? `Upload and start ${scenes.length} jobs` : "Upload and start";
    estimateAnew();
}

for (const id of ["pick-folder", "pick-files"]) {
    const input = find(id);
    input.addEventListener("change", () => { if (input.files.length) choose(chosenFiles(input)); });
    form.querySelector(`[data-pick=${id}]`).addEventListener("click", () => input.click());
}
for (const kind of ["dragenter", "dragover"]) {
    document.addEventListener(kind, (event) => {
        if (![...event.dataTransfer.types].includes("Files")) return;
        event.preventDefault();
        drop.classList.add("over");
    });
}
document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) drop.classList.remove("over"); });
document.addEventListener("drop", (event) => {
    if (![...event.dataTransfer.types].includes("Files")) return; // a word that is dropped on a field
    event.preventDefault();
    drop.classList.remove("over");
    choose(droppedFiles(event.dataTransfer));
});
find("forget").addEventListener("click", () => {
    choice += 1;
    start.disabled = false;
    scenes = null;
    show();
    form.querySelectorAll("input[type=file]").forEach((input) => { input.value = ""; });
    form.querySelector("[data-pick]").focus();
});
known?.addEventListener("change", () => {
    if (known.value) scenes = null;
    show();
});

const paces = [];
function tell({ stage, done, total, files, allFiles }) {
    find("going").hidden = false;
    const bar = find("going-bar"), now = performance.now();
    if (stage === "checking") bar.removeAttribute("value");
    else bar.value = total ? done / total : 1;
    paces.push([now, done]);
    while (paces.length > 2 && now - paces[0][0] > 5000) paces.shift();
    const [before, doneBefore] = paces[0];
    const pace = now > before + 500 ? Math.max(0, (done - doneBefore) / (now - before)) * 1000 : 0;
    const rest = pace ? ` · ${size(pace)}/s · ${left((total - done) / pace)} left` : "";
    find("going-text").textContent = {
        checking: "Everything has arrived; checking it",
        waiting: "The connection is lost; trying again",
        sending: `${size(done)} of ${size(total)} · ${files} of ${allFiles} files${rest}`,
    }[stage];
}

function left(seconds) {
    return seconds < 60 ? `${Math.ceil(seconds)} s` : seconds < 3600 ? `${Math.ceil(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

pause.addEventListener("click", () => {
    if (upload.paused) upload.resume();
    else upload.pause();
    pause.textContent = upload.paused ? "Go on" : "Pause";
    if (upload.paused) find("going-text").textContent = "Paused; what has arrived stays.";
});

addEventListener("beforeunload", (event) => { if (upload) event.preventDefault(); });

/** Nothing else is chosen or started while something is sent: leaving for its job would break off the other. */
function setStarting(is) {
    isStarting = is;
    for (const control of [start, find("forget"), known, ...form.querySelectorAll("[data-pick]")]) {
        if (control) control.disabled = is;
    }
}

/** What a job is asked for besides its photographs. */
function askedFor() {
    const asked = { kind, options: readOptions(form), queue: find("queue")?.value ?? "cpu" };
    if (find("begin-with")?.checked) asked.source_id = find("begin-with").value;
    return asked;
}

/** Sends a scene, or takes the dataset that is chosen, and queues its job; returns that. */
async function startOne(scene, asked, label, isOneOfMany) {
    let id = known?.value;
    if (scene) {
        paces.length = 0;
        upload = new Upload(scene, scene.title || label || "photographs", tell);
        pause.hidden = false;
        id = (await upload.run()).id;
    }
    const body = { ...asked, dataset_id: id };
    if (label) body.label = isOneOfMany ? shortName(`${label}: ${scene.title}`) : label;
    return queueJob(body, `page-${id}-${Date.now()}`);
}

form.addEventListener("submit", async (event) => {
    event.preventDefault();
    faults.hidden = true;
    if (!scenes && !known?.value) {
        complain("Choose photographs first.");
        return;
    }
    setStarting(true);
    try {
        // Before anything is sent: what is wrong with it is told at once, and all of several jobs are asked for alike.
        const asked = askedFor(), label = find("label").value.trim();
        const queued = [];
        for (const scene of scenes ?? [null]) queued.push(await startOne(scene, asked, label, scenes?.length > 1));
        upload = null;
        location.href = queued.length > 1 ? "/" : `/jobs/${queued[0]}`;
    } catch (error) {
        upload = null;
        complain(error.faults?.length ? "This cannot be used as it is:" : error.message, error.faults);
        find("going").hidden = true;
    } finally {
        setStarting(false);
        pause.hidden = true;
        pause.textContent = "Pause";
    }
});

show();
