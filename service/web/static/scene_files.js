// The files that a user points at, and what the service says of them before anything is sent.

import { answer } from "./options.js";

const ARCHIVE = /\.zip$/i;
const ARCHIVE_END_BYTES = 1 << 18; // holds the names of a thousand files
const ARCHIVE_END_TRIES = 4; // the list of contents may ask for more three times

/** All files below what was dropped, with their paths. */
export async function droppedFiles(transfer) {
    const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
    if (!entries.length) return [...transfer.files].map((file) => ({ path: file.name, file }));
    const found = [];
    const walk = async (entry, folder) => {
        const path = folder + entry.name;
        if (entry.isFile) {
            found.push({ path, file: await new Promise((resolve, reject) => entry.file(resolve, reject)) });
            return;
        }
        const reader = entry.createReader();
        for (;;) { // a reader gives its entries in parts
            const part = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
            if (!part.length) return;
            for (const inner of part) await walk(inner, `${path}/`);
        }
    };
    for (const entry of entries) await walk(entry, "");
    return found;
}

/** All files that were chosen in a dialogue, with their paths. */
export function chosenFiles(input) {
    return [...input.files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
}

/** Folders of one scene; whoever drops these beside each other means one. */
const PARTS_OF_A_SCENE = new Set(["images", "input", "masks", "sparse", "colmap", "distorted", "depths", "depth", "normal"]);

/** The scenes of what was chosen: one each for several archives or folders beside each other, else a single one. */
export async function scenesOf(found) {
    const groups = new Map();
    for (const item of found) {
        const first = item.path.split("/")[0];
        groups.set(first, [...(groups.get(first) ?? []), item]);
    }
    const names = [...groups.keys()];
    const areScenes = names.length > 1 && names.every((name) => !PARTS_OF_A_SCENE.has(name.toLowerCase()) && (ARCHIVE.test(name) || groups.get(name).every(({ path }) => path.includes("/"))));
    if (!areScenes) return [await sceneOf(found)];
    const scenes = [];
    for (const name of names) {
        try {
            scenes.push(await sceneOf(groups.get(name)));
        } catch (error) {
            const sentences = error.faults ?? [error.message];
            throw Object.assign(new Error(`${name}: ${error.message}`), { faults: sentences.map((sentence) => `${name}: ${sentence}`) });
        }
    }
    return scenes;
}

/**
 * What to send: {archive} or {files: [{name, file}]}, what the scene may be called, and notes on what is left out.
 * Throws an error with sentences for the user where the service would refuse it.
 */
export async function sceneOf(found) {
    const archives = found.filter(({ path }) => ARCHIVE.test(path));
    const isArchive = archives.length === 1 && found.length === 1;
    const preview = isArchive ? await previewArchive(archives[0].file) : await previewFiles(found);
    if (preview.refusals.length) {
        const sentences = [...new Set([...preview.refusals.map(({ detail }) => detail), ...preview.notes])];
        throw Object.assign(new Error(sentences[0]), { faults: sentences });
    }
    const facts = { notes: preview.notes, photographs: preview.photographs, posed: preview.has_poses };
    if (isArchive) {
        const [{ file }] = archives;
        return { ...facts, archive: file, title: file.name.replace(ARCHIVE, ""), bytes: file.size };
    }
    const byPath = new Map(found.map(({ path, file }) => [path, file]));
    return {
        ...facts,
        files: preview.files.map(({ name, path }) => ({ name, file: byPath.get(path) })),
        title: preview.folder.replace(/\/$/, "").split("/").pop(),
        bytes: preview.files.reduce((sum, { size_bytes }) => sum + size_bytes, 0),
    };
}

function previewFiles(found) {
    const files = found.map(({ path, file }) => ({ path, size_bytes: file.size }));
    return fetch("/v1/scene-previews", {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ files }),
    }).then(answer);
}

/** What the list of contents at the end of an archive says. */
async function previewArchive(file) {
    let preview = { needed_bytes: ARCHIVE_END_BYTES };
    for (let attempt = 0; preview.needed_bytes !== null && attempt < ARCHIVE_END_TRIES; attempt++) {
        preview = await fetch(`/v1/scene-previews/archive?size_bytes=${file.size}`, {
            method: "POST",
            headers: { "Content-Type": "application/octet-stream" },
            body: file.slice(Math.max(0, file.size - preview.needed_bytes)),
        }).then(answer);
    }
    return preview;
}
