// Which of the files that a user points at belong to a scene, and what they are called there.

const MODEL = /^((colmap\/|distorted\/)?sparse(\/[0-9]+)?)\/(cameras|images|points3D|rigs|frames)\.(bin|txt)$/;
const PICTURE = /\.(jpe?g|png|tiff?|webp|bmp|exr|hdr)$/i;
const CLUTTER = /(^|\/)(\.[^/]*|__MACOSX\/.*|thumbs\.db|desktop\.ini|Icon\r?)$/i;
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
    // As engine/core/scene_layout.py decides.
    const pictures = named.filter(({ name }) => PICTURE.test(name));
    const place = ["images/", "input/"].find((folder) => pictures.some(({ name }) => name.startsWith(folder))) ?? "";
    const kept = named.filter(({ name }) => MODEL.test(name) || (name.startsWith("masks/") && PICTURE.test(name)));
    for (const { name, file } of pictures) {
        if (name.startsWith(place) && !/(^|\/)masks\//.test(name)) kept.push({ name: `images/${name.slice(place.length)}`, file });
    }
    const photographs = kept.filter(({ name }) => name.startsWith("images/") && PICTURE.test(name)).length;
    if (!photographs) throw new Error("There are no photographs in this; choose a folder of photographs, or one that holds images/.");
    const sent = new Set(kept.map(({ file }) => file));
    return {
        files: kept.sort((a, b) => (a.name < b.name ? -1 : 1)),
        title: top.replace(/\/$/, "").split("/").pop(),
        leftOut: named.filter(({ file }) => !sent.has(file)).map(({ name }) => name),
        photographs,
        posed: kept.some(({ name }) => MODEL.test(name)),
        bytes: kept.reduce((sum, { file }) => sum + file.size, 0),
    };
}

/** The folder, with its slash, that is around all paths and is no part of a scene. */
function commonFolder(paths) {
    let folder = "";
    for (;;) {
        const tops = new Set(paths.map((path) => path.slice(folder.length)).map((path) => (path.includes("/") ? path.slice(0, path.indexOf("/") + 1) : "")));
        const [top] = tops;
        if (tops.size !== 1 || !top || /^(images|masks|sparse|colmap|distorted)\/$/.test(top)) return folder;
        folder += top;
    }
}
