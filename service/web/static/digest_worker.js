// SHA-256 of files: {id, file} in, {id, sha256} out.

import { sha256 } from "./vendor/sha256.js";

const PIECE_BYTES = 4 << 20;
const WHOLE_BYTES = 64 << 20; // the browser's own is faster, but takes all of a file at once

onmessage = async ({ data: { id, file } }) => {
    try {
        postMessage({ id, sha256: await digestOf(file) });
    } catch (error) {
        postMessage({ id, error: `The file cannot be read (${error.name}).` });
    }
};

async function digestOf(file) {
    // not there where the page came over plain HTTP from another machine
    if (self.crypto?.subtle && file.size <= WHOLE_BYTES) {
        return new Uint8Array(await crypto.subtle.digest("SHA-256", await file.arrayBuffer()));
    }
    const digest = sha256.create();
    for (let start = 0; start < file.size; start += PIECE_BYTES) {
        digest.update(new Uint8Array(await file.slice(start, start + PIECE_BYTES).arrayBuffer()));
    }
    return digest.digest();
}
