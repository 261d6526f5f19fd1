// What a job would take, asked of the service anew whenever its options change.

import { readOptions } from "./options.js";

const PAUSE_MS = 350;

/**
 * Shows the estimate of the job that `form` describes in `place`; returns what asks anew.
 * `chosen` says what the job would work on: {scene, dataset, queue}.
 */
export function showEstimates(form, place, chosen) {
    let timer = 0, latest = 0;
    const ask = async () => {
        const number = ++latest;
        const wrong = form.querySelector("input:invalid, select:invalid");
        if (wrong) return show(number, `${wrong.labels?.[0]?.textContent ?? wrong.id}: ${wrong.validationMessage}`);
        const { scene, dataset, queue } = chosen();
        const body = { kind: form.getAttribute("data-kind"), queue };
        try {
            body.options = readOptions(form);
        } catch (error) {
            return show(number, error.message);
        }
        if (scene) body.photographs = await sizesOf(scene);
        else if (dataset) body.dataset_id = dataset;
        if (!body.dataset_id && !body.photographs?.length) {
            show(number, "");
            return showPresets(number, null);
        }
        const { response, answer } = await estimateOf(body);
        if (response?.ok && answer?.estimate) show(number, `This takes ${answer.estimate.text}, within a factor of two.`);
        else if (response?.status === 422) show(number, [...new Set((answer?.errors ?? []).map((fault) => fault.detail))].join(" ") || answer?.detail);
        else show(number, "");
        return showPresets(number, body);
    };
    const show = (number, text) => {
        if (number !== latest) return; // another question has been asked since
        place.textContent = text;
        place.hidden = !text;
    };
    /** What each preset would take with the other options as they are. */
    const showPresets = (number, body) => Promise.all([...form.querySelectorAll("output[data-preset]")].map(async (output) => {
        const { answer } = body ? await estimateOf({ ...body, options: { ...body.options, preset: output.dataset.preset } }) : {};
        if (number === latest) output.textContent = answer?.estimate ? answer.estimate.text.replace(/^./, (letter) => letter.toUpperCase()) : "";
    }));
    const soon = () => {
        clearTimeout(timer);
        timer = setTimeout(ask, PAUSE_MS);
    };
    form.addEventListener("input", soon);
    form.addEventListener("change", soon);
    return soon;
}

async function estimateOf(body) {
    const response = await fetch("/v1/estimates", {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
    }).catch(() => null);
    return { response, answer: await response?.json().catch(() => null) };
}

/** The size of one photograph, taken for that of all; nothing where the browser cannot read it. */
async function sizesOf(scene) {
    if (scene.sizes === undefined) {
        scene.sizes = [];
        const first = scene.files?.find(({ name }) => /^images\/.*\.(jpe?g|png|webp|bmp)$/i.test(name));
        const picture = first && await createImageBitmap(first.file).catch(() => null);
        if (picture) {
            scene.sizes = [{ width_px: picture.width, height_px: picture.height, count: scene.photographs }];
            picture.close();
        }
    }
    return scene.sizes;
}
