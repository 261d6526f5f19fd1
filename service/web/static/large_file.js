// Sends one large file in parts, over several connections at once; what has arrived before is not sent again.

import { answer } from "./options.js";

export const LARGE_BYTES = 32 << 20;
const PARALLEL_PARTS = 4;
const MAX_STORED_BEFORE = 30; // so often the same file may have been sent to the dataset and removed there
const FIRST_PAUSE_MS = 200, LAST_PAUSE_MS = 3000;
const VERSION = { "Tus-Resumable": "1.0.0" };

/**
 * Send a file and return when it is stored; the same call again goes on with what has arrived.
 * @param upload sends and repeats, an Upload of upload.js
 * @param dataset id of the dataset
 * @param name what the file is called there; null for a ZIP file that is unpacked
 * @param file the file
 * @param sha256 its digest, bytes
 * @param tell hears the bytes that have gone out
 */
export async function sendInParts(upload, dataset, name, file, sha256, tell) {
    const found = await findOrCreate(upload, dataset, name, file, hex(sha256));
    if (found === null) return;
    const { address, view } = found;
    try {
        const task = await sendParts(upload, address, view, file, tell) ?? await storeWhole(upload, address, file);
        await waitForTask(upload, task);
    } catch (error) {
        // The answer to the last part was lost, and the file was stored before it was asked for again.
        if (error.status !== 404 || !await isStored(upload, dataset, name, hex(sha256))) throw error;
    }
}

/** The upload of a file, a new one unless one is under way; null where it is a ZIP file that was unpacked. */
async function findOrCreate(upload, dataset, name, file, sha256) {
    const metadata = Object.entries({ ...(name === null ? {} : { path: name }), sha256 });
    const headers = {
        ...VERSION,
        "Upload-Length": String(file.size),
        "Upload-Metadata": metadata.map(([key, value]) => `${key} ${base64(new TextEncoder().encode(value))}`).join(","),
    };
    const key = `page-upload-${hex(await upload.digest(new Blob([`${dataset}\n${name}\n${sha256}`])))}`;
    for (let number = 0; number < MAX_STORED_BEFORE; number++) {
        try {
            const found = await upload.again(async () => {
                const response = await fetch(`/v1/datasets/${dataset}/uploads`, {
                    method: "POST", headers: { ...headers, "Idempotency-Key": `${key}-${number}` },
                });
                return { view: await answer(response), address: response.headers.get("Location") };
            });
            const { offset_bytes: offset, part_bytes: part } = found.view;
            if (offset === file.size || offset % part === 0) return found;
            // another program has sent some of it in order, and has not ended where a part begins
            await upload.again(() => fetch(found.address, { method: "DELETE", headers: VERSION }).then(done));
        } catch (error) {
            if (error.status !== 404) throw error; // it was stored or given up since, and the next one may be there
            if (name === null && (await newestUpload(upload, dataset))?.state === "succeeded") return null;
        }
    }
    throw new Error(`${file.name} was sent ${MAX_STORED_BEFORE} times before; choose it for a new dataset.`);
}

/** Send the parts that are lacking; return the address of the task that stores the file, if one began. */
async function sendParts(upload, address, { offset_bytes, part_bytes, parts_ahead }, file, tell) {
    const ahead = new Set(parts_ahead), starts = [], sent = new Map();
    for (let start = offset_bytes; start < file.size; start += part_bytes) {
        if (!ahead.has(start)) starts.push(start);
    }
    const lengthFrom = (start) => Math.min(part_bytes, file.size - start);
    const before = file.size - starts.reduce((sum, start) => sum + lengthFrom(start), 0);
    const record = (start, bytes) => {
        sent.set(start, bytes);
        tell(before + [...sent.values()].reduce((sum, count) => sum + count, 0));
    };
    tell(before);
    let task = null;
    const work = async () => {
        for (let start = starts.shift(); start !== undefined; start = starts.shift()) {
            const part = file.slice(start, start + part_bytes), from = start;
            const sha256 = await upload.digest(part);
            const headers = await upload.again(() => upload.put(`${address}/parts/${from}`, part, sha256, (bytes) => record(from, bytes)));
            task = headers.location ?? task;
        }
    };
    await Promise.all(Array.from({ length: PARALLEL_PARTS }, work)).catch((error) => {
        starts.length = 0;
        throw error;
    });
    return task;
}

/** Have a file stored of which all has come; return the address of the task. */
async function storeWhole(upload, address, file) {
    return upload.again(async () => {
        const response = await fetch(address, {
            method: "PATCH",
            headers: { ...VERSION, "Upload-Offset": String(file.size), "Content-Type": "application/offset+octet-stream" },
        });
        return (await done(response)).headers.get("Location");
    });
}

async function waitForTask(upload, address) {
    for (let pause = FIRST_PAUSE_MS; ; pause = Math.min(1.5 * pause, LAST_PAUSE_MS)) {
        const task = await upload.again(() => fetch(address).then(answer));
        if (task.problem) await answer(new Response(JSON.stringify(task.problem), { status: task.problem.status }));
        if (task.state === "succeeded") return;
        await new Promise((resolve) => setTimeout(resolve, pause));
    }
}

/** Whether a dataset has a file, or what was in a ZIP file, whose upload is over. */
async function isStored(upload, dataset, name, sha256) {
    if (name === null) {
        const task = await newestUpload(upload, dataset);
        if (task) await waitForTask(upload, `/v1/datasets/${dataset}/tasks/${task.id}`);
        return Boolean(task);
    }
    const path = name.split("/").map(encodeURIComponent).join("/");
    const response = await upload.again(() => fetch(`/v1/datasets/${dataset}/files/${path}`, { method: "HEAD" }));
    return response.headers.get("ETag") === `"${sha256}"`;
}

async function newestUpload(upload, dataset) {
    const { tasks } = await upload.again(() => fetch(`/v1/datasets/${dataset}/tasks?limit=50`).then(answer));
    return tasks.find(({ kind }) => kind === "upload");
}

/** An answer without a body. */
async function done(response) {
    if (!response.ok) await answer(response);
    return response;
}

export function hex(bytes) {
    return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

export function base64(bytes) {
    return btoa(String.fromCharCode(...bytes));
}
