// Forms of options: what is filled in becomes the options of a job; what is left empty stays as it is.

import { plainName } from "./file_names.js";

/** The options that a form asks for, nested. */
export function readOptions(form) {
    const options = {};
    for (const field of form.querySelectorAll("[data-path]")) {
        const value = valueOf(field);
        if (value === undefined) continue;
        const path = field.dataset.path.split(".");
        const last = path.pop();
        path.reduce((section, name) => (section[name] ??= {}), options)[last] = value;
    }
    return options;
}

function valueOf(field) {
    if (field.dataset.type.startsWith("upload")) return uploadNames(field);
    if (field.dataset.type === "radio") return field.querySelector("input:checked")?.value;
    if (field.dataset.type === "files") return [...field.querySelectorAll("input:checked")].map((box) => box.value);
    const text = field.value.trim();
    if (text === "") return undefined;
    if (field.dataset.type === "number") return Number(text);
    if (field.dataset.type === "yes_no") return text === "true";
    if (field.dataset.type === "numbers") return text.split(/[\s,]+/).map(Number);
    if (field.dataset.type === "json") return jsonOf(text, field);
    if (field.dataset.type === "list") return text.split(",").map((part) => part.trim()).filter(Boolean);
    return text;
}

function jsonOf(text, field) {
    try {
        return JSON.parse(text);
    } catch {
        throw new Error(`${field.labels?.[0]?.textContent ?? field.dataset.path}: this is not JSON.`);
    }
}

/** The names by which options know the files of a field; undefined where none was chosen. */
function uploadNames(field) {
    const names = [...field.files].map((file) => plainName(file, "file"));
    if (!names.length) return undefined;
    return field.dataset.type === "uploads" ? names : names[0];
}

/** The files that a form sends, as [{name, file}]. */
export function filesOf(form) {
    const files = [...form.querySelectorAll("[data-type^=upload]")].flatMap((field) => [...field.files].map((file) => ({ name: plainName(file, "file"), file })));
    const double = files.find(({ name }, place) => files.some((other, before) => before < place && other.name === name));
    if (double) throw new Error(`Two of the files are called ${double.name}; give one another name.`);
    return files;
}

/** Defaults that depend on the preset follow it. */
export function followPreset(form) {
    const preset = form.querySelector("[data-path=preset]");
    if (!preset) return;
    const show = () => {
        const name = valueOf(preset) ?? preset.dataset.default;
        for (const field of form.querySelectorAll("[data-defaults]:not([data-defaults=''])")) {
            const text = JSON.parse(field.dataset.defaults)[name] ?? "";
            if (field.tagName === "SELECT") field.options[0].textContent = `${text || "as is"} (default)`;
            else field.placeholder = text || "–";
        }
    };
    preset.addEventListener("change", show);
    show();
}

/** Fills a form with the options of another job; what is as the preset has it stays empty. */
export function fillOptions(form, given) {
    const valueAt = (path) => path.split(".").reduce((section, name) => section?.[name], given);
    const preset = form.querySelector("[data-path=preset]");
    if (preset && given.preset) preset.querySelector(`[value="${CSS.escape(given.preset)}"]`)?.click();
    for (const field of form.querySelectorAll("[data-path]")) {
        const value = valueAt(field.dataset.path);
        if (value === undefined || value === null || field === preset || field.dataset.type.startsWith("upload")) continue;
        if (field.dataset.type === "files") {
            const boxes = [...field.querySelectorAll("input")];
            for (const box of boxes) box.checked = value.includes(box.value) && !box.disabled;
            field.append(...value.filter((name) => !boxes.some((box) => box.value === name)).map(boxFor));
            continue;
        }
        const defaults = field.dataset.defaults ? JSON.parse(field.dataset.defaults) : {};
        const usual = defaults[given.preset] ?? field.dataset.default ?? "";
        const text = textOf(field.dataset.type, value);
        const shown = field.dataset.type === "yes_no" ? (value ? "yes" : "no") : text;
        if (shown !== String(usual) && text !== "") field.value = text;
    }
}

/** A box for a file that the form does not offer by itself: formats can have other names. */
function boxFor(name) {
    const label = Object.assign(document.createElement("label"), { className: "check" });
    const span = document.createElement("span");
    span.append(Object.assign(document.createElement("b"), { textContent: name }));
    label.append(Object.assign(document.createElement("input"), { type: "checkbox", value: name, checked: true }), span);
    return label;
}

function textOf(type, value) {
    if (type === "numbers") return value.join(" ");
    if (type === "list" && Array.isArray(value)) return value.join(", ");
    return type === "json" || typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** Queues a job; returns its id. Throws an error whose `faults` are single sentences. */
export async function queueJob(body, key) {
    const response = await fetch("/v1/jobs", {
        method: "POST",
        headers: { "Content-Type": "application/json", "Idempotency-Key": key },
        body: JSON.stringify(body),
    });
    return (await answer(response)).id;
}

/** The JSON of an answer, or an error with the problem's words. */
export async function answer(response) {
    if (response.ok) return response.json();
    if (response.status === 401) location.href = `/sign-in?next=${encodeURIComponent(location.pathname + location.search + location.hash)}`;
    const problem = await response.json().catch(() => ({}));
    const error = new Error(problem.detail ?? `The service answered ${response.status}.`);
    error.status = response.status;
    error.faults = (problem.errors ?? []).map((fault) => {
        const where = (fault.pointer ?? "").replace(/^#\/options\//, "").replaceAll("/", ".");
        const isNamed = fault.detail.includes(where.split(".").at(-1));
        return problem.type?.endsWith(":options") && !isNamed ? `${where}: ${fault.detail}` : fault.detail;
    });
    throw error;
}
