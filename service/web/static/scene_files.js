// Which of the files that a user points at belong to a scene, and what they are called there.

const PARTS = /^(images|masks|sparse|colmap\/sparse)\//;
const PICTURE = /\.(jpe?g|png|tiff?|webp|bmp|exr|hdr)$/i;
const CLUTTER = /(^|\/)(\.[^/]*|__MACOSX\/.*|thumbs\.db|desktop\.ini)$/i;
const ARCHIVE = /\.zip$/i;

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

/**
 * What to send: {archive} or {files: [{name, file}]}, what the scene may be called, and what is left out.
 * Throws an error with a sentence for the user where there is nothing to send.
 */
export function sceneOf(found) {
    const files = found.filter(({ path }) => !CLUTTER.test(path));
    const archives = files.filter(({ path }) => ARCHIVE.test(path));
    if (archives.length === 1 && files.length === 1) {
        const [{ file }] = archives;
        return { archive: file, title: file.name.replace(ARCHIVE, ""), leftOut: [], photographs: null, posed: null, bytes: file.size };
    }
    const top = commonFolder(files.map(({ path }) => path));
    const named = files.map(({ path, file }) => ({ name: path.slice(top.length), file }));
    let kept = named.filter(({ name }) => PARTS.test(name));
    if (!kept.some(({ name }) => name.startsWith("images/"))) {
        // A folder of photographs, and nothing else that is known.
        kept = named.filter(({ name }) => PICTURE.test(name) && !name.includes("/")).map(({ name, file }) => ({ name: `images/${name}`, file }));
    }
    const photographs = kept.filter(({ name }) => name.startsWith("images/") && PICTURE.test(name)).length;
    if (!photographs) throw new Error("There are no photographs in this; choose a folder of photographs, or one that holds images/.");
    const sent = new Set(kept.map(({ file }) => file));
    return {
        files: kept.sort((a, b) => (a.name < b.name ? -1 : 1)),
        title: top.replace(/\/$/, "").split("/").pop(),
        leftOut: named.filter(({ file }) => !sent.has(file)).map(({ name }) => name),
        photographs,
        posed: kept.some(({ name }) => /^(colmap\/)?sparse\/(0\/)?cameras\.(bin|txt)$/.test(name)),
        bytes: kept.reduce((sum, { file }) => sum + file.size, 0),
    };
}

/** The folder, with its slash, that is around all paths and is no part of a scene. */
function commonFolder(paths) {
    let folder = "";
    for (;;) {
        const tops = new Set(paths.map((path) => path.slice(folder.length)).map((path) => (path.includes("/") ? path.slice(0, path.indexOf("/") + 1) : "")));
        const [top] = tops;
        if (tops.size !== 1 || !top || /^(images|masks|sparse|colmap)\/$/.test(top)) return folder;
        folder += top;
    }
}
