// Sends a scene file by file, each with its digest; what has arrived before is not sent again.

import { shortName } from "./file_names.js";
import { LARGE_BYTES, base64, hex, sendInParts } from "./large_file.js";
import { answer } from "./options.js";

const PARALLEL = 4;
const TRIES = 6;
const BATCH_FILES = 200, BATCH_BYTES = 64 << 20; // looked at together, while those before them are sent

/** An upload that can be paused, goes on by itself after a break, and with the next choice of the same files. */
export class Upload {
    /**
     * @param scene as of scene_files.js
     * @param title what to call it
     * @param tell hears {done, total, files, allFiles, stage}
     * @param holds what the dataset holds
     */
    constructor(scene, title, tell, holds = "photographs") {
        Object.assign(this, { scene, title, tell, holds });
        this.sent = new Map(); // bytes by name
        this.running = new Set();
        this.places = PARALLEL; // requests that may be begun
        this.waiting = [];
        this.paused = null;
        this.isOver = false; // one file was refused: the others are not tried again
        this.worker = new Worker(new URL("./digest_worker.js", import.meta.url), { type: "module" });
        this.asked = new Map();
        this.worker.onmessage = ({ data }) => {
            const { resolve, reject } = this.asked.get(data.id);
            this.asked.delete(data.id);
            if (data.error) reject(new Error(data.error));
            else resolve(data.sha256);
        };
    }

    /** Everything up to a checked dataset; returns it. */
    async run() {
        try {
            const { archive } = this.scene;
            const items = archive ? [{ name: archive.name, file: archive }] : this.scene.files;
            let dataset = await this.dataset(items);
            if (dataset.state === "open") {
                const arrived = archive ? new Map() : await this.arrived(dataset.id);
                if (!archive) await this.removeOthers(dataset.id, arrived, items);
                await this.sendAll(dataset.id, items, arrived);
                this.report("checking");
            }
            const { id } = dataset;
            while (dataset.state !== "committed") { // an answer comes after some seconds, whether it is over or not
                dataset = await this.again(() => fetch(`/v1/datasets/${id}/commit`, { method: "POST" }).then(answer));
            }
            return dataset;
        } finally {
            this.worker.terminate();
        }
    }

    pause() {
        if (this.paused) return;
        let go;
        this.paused = Object.assign(new Promise((resolve) => { go = resolve; }), { go });
        this.running.forEach((request) => request.abort());
    }

    resume() {
        this.paused?.go();
        this.paused = null;
    }

    /** The dataset that was made for just these files, or a new one. */
    async dataset(items) {
        const text = [this.title, this.holds, ...items.map(({ name, file }) => `${name}\0${file.size}\0${file.lastModified}`)].join("\n");
        const key = `page-${await this.digest(new Blob([text])).then(hex)}`;
        const make = (key) => fetch("/v1/datasets", {
            method: "POST",
            headers: { "Content-Type": "application/json", "Idempotency-Key": key },
            body: JSON.stringify({ name: shortName(this.title), holds: this.holds }),
        }).then(answer);
        try {
            return await this.again(() => make(key));
        } catch (error) {
            if (error.status !== 404) throw error; // it was deleted since
            return this.again(() => make(`${key}-${Date.now()}`));
        }
    }

    async arrived(id) {
        const there = new Map();
        let cursor = "";
        do {
            const page = await this.again(() => fetch(`/v1/datasets/${id}/files?limit=5000${cursor}`).then(answer));
            page.files.forEach((file) => there.set(file.path, file));
            cursor = page.next ? `&cursor=${encodeURIComponent(page.next)}` : "";
        } while (cursor);
        return there;
    }

    async removeOthers(id, arrived, items) {
        const wanted = new Set(items.map(({ name }) => name));
        for (const name of arrived.keys()) {
            if (wanted.has(name)) continue;
            await this.again(async () => {
                const response = await fetch(address(id, name), { method: "DELETE" });
                if (!response.ok && response.status !== 404) await answer(response); // it would be trained on
            });
        }
    }

    async sendAll(id, items, arrived) {
        this.items = items;
        this.finished = 0;
        const batches = batchesOf(items), looked = [];
        const waiting = batches.flatMap((batch, number) => batch.map((item) => [item, number]));
        const look = (number) => {
            if (!looked[number]) { // after the one before, so that what is sent first is read first
                const before = looked[number - 1]?.catch(() => {});
                looked[number] = (async () => { await before; return this.lookAt(id, batches[number], arrived); })();
                looked[number].catch(() => {}); // told where it is waited for
            }
            return looked[number];
        };
        this.report("sending");
        const work = async () => {
            for (let next = waiting.shift(); next; next = waiting.shift()) {
                const [item, number] = next;
                const digests = look(number);
                if (number + 1 < batches.length) look(number + 1);
                const { sha256, isThere } = (await digests).get(item.name);
                if (!isThere) await this.send(id, item, sha256);
                this.sent.set(item.name, item.file.size);
                this.finished += 1;
                this.report("sending");
            }
        };
        try {
            await Promise.all(Array.from({ length: PARALLEL }, work));
        } catch (error) {
            this.isOver = true;
            waiting.length = 0;
            this.running.forEach((request) => request.abort());
            throw error;
        }
    }

    /** The digest of each file of a batch, and whether the dataset has it: from before, or from another one of its owner. */
    async lookAt(id, batch, arrived) {
        const found = new Map();
        for (const { name, file } of batch) {
            const sha256 = await this.digest(file);
            found.set(name, { sha256, isThere: arrived.get(name)?.sha256 === hex(sha256) });
        }
        const lacking = [...found].filter(([name, { isThere }]) => !isThere && name !== this.scene.archive?.name);
        if (!lacking.length) return found;
        const files = lacking.map(([path, { sha256 }]) => ({ path, sha256: hex(sha256) }));
        try {
            const reused = await this.again(() => fetch(`/v1/datasets/${id}/files`, {
                method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ files }),
            }).then(answer));
            reused.files.forEach(({ path }) => { found.get(path).isThere = true; });
        } catch (error) {
            if (![404, 405].includes(error.status)) throw error; // a front end of the former version is asked
        }
        return found;
    }

    async send(id, { name, file }, sha256) {
        const isArchive = file === this.scene.archive;
        const tell = (bytes) => {
            this.sent.set(name, bytes);
            this.report("sending");
        };
        try {
            if (file.size >= LARGE_BYTES) await sendInParts(this, id, isArchive ? null : name, file, sha256, tell);
            else await this.again(() => this.put(isArchive ? `/v1/datasets/${id}/archive` : address(id, name), file, sha256, tell));
        } catch (error) {
            error.faults = error.faults?.length ? error.faults : [`${name}: ${error.message}`];
            throw error;
        }
    }

    /** Send a content with its digest, when there is a place for it; returns {location} of the answer. */
    async put(url, content, sha256, tell) {
        while (!this.places) await new Promise((resolve) => this.waiting.push(resolve));
        this.places -= 1;
        try {
            if (this.paused) throw new TypeError("The upload is paused.");
            return await this.putNow(url, content, sha256, tell);
        } finally {
            this.places += 1;
            this.waiting.shift()?.();
        }
    }

    putNow(url, content, sha256, tell) {
        return new Promise((resolve, reject) => {
            const request = new XMLHttpRequest(); // fetch does not tell how much has gone out
            this.running.add(request);
            request.open("PUT", url);
            request.setRequestHeader("Content-Type", "application/octet-stream");
            request.setRequestHeader("Repr-Digest", `sha-256=:${base64(sha256)}:`);
            request.upload.onprogress = ({ loaded }) => tell(loaded);
            const fail = (error) => {
                tell(0); // before it is told that the connection is lost
                reject(error);
            };
            request.onload = () => {
                const isGood = request.status >= 200 && request.status < 300;
                if (isGood) resolve({ location: request.getResponseHeader("Location") });
                else answer(new Response(request.responseText || "{}", { status: request.status })).catch(fail);
            };
            request.onerror = request.onabort = () => fail(new TypeError("The connection broke off."));
            request.onloadend = () => this.running.delete(request);
            request.send(content);
        });
    }

    /** Repeats what failed for want of a connection, or because the service asks to wait. */
    async again(action) {
        for (let attempt = 0; ; attempt++) {
            await this.paused;
            try {
                return await action();
            } catch (error) {
                const passing = error instanceof TypeError || [408, 429, 502, 503, 504].includes(error.status);
                if (this.isOver) throw error;
                if (this.paused) {
                    attempt = 0;
                    continue;
                }
                if (!passing || attempt >= TRIES) throw error;
                this.report("waiting");
                await new Promise((resolve) => setTimeout(resolve, Math.min(15000, 600 * 2 ** attempt)));
            }
        }
    }

    digest(file) {
        const id = this.nextId = (this.nextId ?? 0) + 1;
        return new Promise((resolve, reject) => {
            this.asked.set(id, { resolve, reject });
            this.worker.postMessage({ id, file });
        });
    }

    report(stage) {
        let done = 0;
        this.sent.forEach((bytes) => { done += bytes; });
        this.tell({ stage, done, total: this.scene.bytes, files: this.finished ?? 0, allFiles: this.items?.length ?? 0 });
    }
}

function address(id, name) {
    return `/v1/datasets/${id}/files/${name.split("/").map(encodeURIComponent).join("/")}`;
}

/** Items in groups of which none takes long to read. */
function batchesOf(items) {
    const batches = [];
    let bytes = 0;
    for (const item of items) {
        if (!batches.length || batches.at(-1).length >= BATCH_FILES || bytes + item.file.size > BATCH_BYTES) {
            batches.push([]);
            bytes = 0;
        }
        batches.at(-1).push(item);
        bytes += item.file.size;
    }
    return batches;
}
