// SHA-256 of a stream; the browser's own takes whole files only, and none at all on plain http.
export { sha256 } from "@noble/hashes/sha2.js";
