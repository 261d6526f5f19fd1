// The page of a new job: photographs are chosen or dropped, sent, and their reconstruction is queued.

import { showEstimates } from "./estimate.js";
import { fillOptions, followPreset, queueJob, readOptions } from "./options.js";
import { chosenFiles, droppedFiles, sceneOf } from "./scene_files.js";
import { Upload } from "./upload.js";
import { thousands } from "./numbers.js";

const form = document.getElementById("new-job");
const find = (id) => document.getElementById(id);
const drop = find("drop"), known = find("dataset"), start = find("start"), pause = find("pause"), faults = find("faults");
let scene = null, upload = null, choice = 0;

// By their attributes: a field of the form has the id "dataset".
const kind = form.getAttribute("data-kind"), given = form.getAttribute("data-given");
if (given) fillOptions(form, JSON.parse(given));
followPreset(form);
const estimateAnew = showEstimates(form, find("estimate"), () => ({ scene, dataset: known?.value, queue: find("queue")?.value ?? "cpu" }));

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

async function choose(found) {
    faults.hidden = true;
    const number = ++choice;
    start.disabled = true;
    try {
        const chosen = await sceneOf(found);
        if (number !== choice) return; // others have been chosen since
        scene = chosen;
    } catch (error) {
        if (number !== choice) return;
        scene = null;
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

/** Shows what was chosen, and what the button will do. */
function show() {
    drop.hidden = scene !== null;
    find("chosen").hidden = scene === null;
    const notes = find("chosen-notes");
    notes.replaceChildren();
    if (scene) {
        const what = `${scene.archive ? `${scene.archive.name}, ` : ""}${thousands(scene.photographs)} photographs${scene.posed ? " and a COLMAP model" : ""}`;
        find("chosen-text").textContent = `${scene.title && !scene.archive ? `${scene.title}: ` : ""}${what}, ${size(scene.bytes)}`;
        const add = (text) => notes.append(Object.assign(document.createElement("li"), { textContent: text }));
        if (!scene.posed) add("There is no COLMAP model, so the poses are found first; that takes a while.");
        scene.notes.forEach(add);
        find("label").placeholder = scene.title || "as the folder";
    }
    start.textContent = known?.value && !scene ? "Start" : "Upload and start";
    estimateAnew();
}

for (const id of ["pick-folder", "pick-files"]) {
    const input = find(id);
    input.addEventListener("change", () => { if (input.files.length) choose(chosenFiles(input)); });
    input.parentElement.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        input.click();
    });
}
for (const kind of ["dragenter", "dragover"]) {
    document.addEventListener(kind, (event) => {
        if (![...event.dataTransfer.types].includes("Files")) return;
        event.preventDefault();
        drop.classList.add("over");
    });
}
document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) drop.classList.remove("over"); });
document.addEventListener("drop", async (event) => {
    event.preventDefault();
    drop.classList.remove("over");
    if (!upload) choose(await droppedFiles(event.dataTransfer));
});
find("forget").addEventListener("click", () => {
    choice += 1;
    start.disabled = false;
    scene = null;
    show();
    form.querySelectorAll("input[type=file]").forEach((input) => { input.value = ""; });
    form.querySelector("label.button").focus();
});
known?.addEventListener("change", () => {
    if (known.value) scene = null;
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

form.addEventListener("submit", async (event) => {
    event.preventDefault();
    faults.hidden = true;
    if (!scene && !known?.value) {
        complain("Choose photographs first.");
        return;
    }
    start.disabled = true;
    try {
        let id = known?.value;
        const label = find("label").value.trim();
        if (scene) {
            upload = new Upload(scene, scene.title || label || "photographs", tell);
            pause.hidden = false;
            id = (await upload.run()).id;
        }
        const body = { kind, dataset_id: id, options: readOptions(form), queue: find("queue")?.value ?? "cpu" };
        if (label) body.label = label;
        const job = await queueJob(body, `page-${id}-${Date.now()}`);
        upload = null;
        location.href = `/jobs/${job}`;
    } catch (error) {
        upload = null;
        complain(error.faults?.length ? "This cannot be used as it is:" : error.message, error.faults);
        find("going").hidden = true;
    } finally {
        start.disabled = false;
        pause.hidden = true;
        pause.textContent = "Pause";
    }
});

show();
