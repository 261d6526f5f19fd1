// SHA-256 of files, a piece at a time: {id, file} in, {id, sha256} out.

import { sha256 } from "./vendor/sha256.js";

const PIECE_BYTES = 4 << 20;

onmessage = async ({ data: { id, file } }) => {
    try {
        const digest = sha256.create();
        for (let start = 0; start < file.size; start += PIECE_BYTES) {
            digest.update(new Uint8Array(await file.slice(start, start + PIECE_BYTES).arrayBuffer()));
        }
        postMessage({ id, sha256: digest.digest() });
    } catch (error) {
        postMessage({ id, error: `The file cannot be read (${error.name}).` });
    }
};
