// Parts that forms of pictures share: what their fields say, which of them count, and the files that they send.

import { Upload } from "./upload.js";

/** What the named fields say; files are left out. */
export function fieldValues(form) {
    const found = {};
    for (const { name, type, value, checked } of form.elements) {
        if (!name || type === "file") continue;
        found[name] = type === "checkbox" ? checked : type === "range" || type === "number" ? Number(value) : value;
    }
    return found;
}

/** Shows the numbers of sliders, and those fields that `counts` for what their `data-needs` says. */
export function showFields(form, counts) {
    for (const output of form.querySelectorAll("output")) output.textContent = `${output.htmlFor.value && document.getElementById(output.htmlFor.value).value}${output.dataset.unit}`;
    for (const field of form.querySelectorAll("[data-needs]")) field.hidden = !counts(field.dataset.needs);
}

/** Whether values are as wanted: `name=value value`, or `name=*` for any. */
export function holds(needs, values) {
    const [name, wanted] = needs.split("=");
    return wanted === "*" ? Boolean(values[name]) : wanted.split(" ").includes(String(values[name]));
}

/** Files sent as a dataset that holds files, once for as long as they are the same. */
export class SentFiles {
    constructor(title, largest, say) {
        Object.assign(this, { title, largest, say, key: "", id: null });
    }

    /** The id of the dataset of [{name, file}]; null where there are none. */
    async dataset(files) {
        const key = files.map(({ name, file }) => `${name} ${file.size} ${file.lastModified}`).join("\n");
        if (key !== this.key) {
            const large = files.find(({ file }) => file.size > this.largest);
            if (large) throw new Error(`${large.name} is larger than the service takes.`);
            this.say("Sending the files …");
            const scene = { files, bytes: files.reduce((sum, { file }) => sum + file.size, 0) };
            this.id = files.length ? (await new Upload(scene, this.title, () => {}, "files").run()).id : null;
            this.key = key;
        }
        return this.id;
    }
}
