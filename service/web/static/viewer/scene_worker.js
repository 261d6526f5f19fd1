// Loads a scene and keeps it in order, beside the page: {load, views}, then {position, forward, reach, order,
// limit} again and again; answers are {loaded, total}, {scene}, {order, count, limit} or {error}. Besides,
// {pick: {origin, direction, q}, id} is answered by {picked, id}, and {edit, show} by {edited}: what crop and
// clean would remove is left out of the order, or with the show "removed" all the rest; nothing where that fails.

import { removedBy } from "./cleaning.js";
import { pick } from "./picking.js";
import { readGaussians } from "./ply.js";
import { makeSorter, shownBy } from "./sorting.js";

const TRIES = 5;
let sort = null;
let scene = null; // {count, geometry, bounds, views, shown}: what picking and editing read
let hidden = null;

/** All bytes of a file; a download that breaks off goes on where it was. */
async function download(url, tell) {
    let pieces = [], loaded = 0, etag = null;
    for (let attempt = 0; ; attempt++) {
        try {
            const headers = loaded > 0 && etag ? { Range: `bytes=${loaded}-`, "If-Range": etag } : {};
            const response = await fetch(url, { headers });
            if (!response.ok) throw Object.assign(new Error(`The scene cannot be loaded (status ${response.status}).`), { final: response.status < 500 });
            if (response.status !== 206) [pieces, loaded] = [[], 0];
            etag = response.headers.get("etag");
            const rest = Number(response.headers.get("content-length") ?? NaN);
            const total = loaded + rest;
            for (const reader = response.body.getReader(); ;) {
                const { done, value } = await reader.read();
                if (done) break;
                pieces.push(value);
                loaded += value.length;
                tell(loaded, total);
            }
            if (loaded < total) throw new Error("The connection broke off.");
            return joined(pieces, loaded);
        } catch (error) {
            if (error.final || attempt >= TRIES) throw error;
            await new Promise((resolve) => setTimeout(resolve, 500 * 2 ** attempt));
        }
    }
}

function joined(pieces, length) {
    const bytes = new Uint8Array(length);
    let at = 0;
    for (const piece of pieces) {
        bytes.set(piece, at);
        at += piece.length;
    }
    return bytes;
}

async function load(url, views) {
    let told = 0;
    const bytes = await download(url, (loaded, total) => {
        if (loaded < total && performance.now() - told < 50) return;
        told = performance.now();
        postMessage({ loaded, total });
    });
    const read = readGaussians(bytes);
    const shown = shownBy(read.count, read.geometry, views ?? []);
    sort = makeSorter({ ...read, shown }); // before the arrays go to the page
    scene = { count: read.count, geometry: read.geometry.slice(), bounds: read.bounds.slice(), views: views ?? [], shown };
    postMessage({ scene: read }, [read.geometry.buffer, read.harmonics.buffer, read.bounds.buffer, ...(read.materials ? [read.materials.buffer] : [])]);
}

function edit(wanted, show) {
    try {
        const { removed, counts, kept } = removedBy(scene, scene.views, wanted);
        hidden = show === "all" ? null : show === "removed" ? removed.map((mark) => 1 - mark) : removed;
        postMessage({ edited: { counts, kept } });
    } catch (error) { // as where the memory for a large scene is lacking
        hidden = null;
        postMessage({ edited: { error: error.message } });
    }
}

onmessage = ({ data }) => {
    if (data.load) {
        load(data.load, data.views).catch((error) => postMessage({ error: error.message }));
        return;
    }
    if (data.pick) {
        const unseen = scene.shown.map((mark, i) => (mark && !hidden?.[i] ? 0 : 1)); // what is not drawn cannot be meant
        postMessage({ picked: pick(scene, data.pick.origin, data.pick.direction, data.pick.q, unseen), id: data.id });
        return;
    }
    if (data.edit) {
        edit(data.edit, data.show);
        return;
    }
    const count = sort(data.position, data.forward, data.reach, data.order, data.limit, hidden);
    postMessage({ order: data.order, count, limit: data.limit }, [data.order.buffer]);
};
