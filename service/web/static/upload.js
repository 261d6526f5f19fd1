// Sends a scene file by file, each with its digest; what has arrived before is not sent again.

import { answer } from "./options.js";

const PARALLEL = 4;
const TRIES = 6;

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
        this.paused = null;
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
                await this.sendAll(items, (item) => archive ? `/v1/datasets/${dataset.id}/archive` : address(dataset.id, item.name), arrived);
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
            body: JSON.stringify({ name: this.title, holds: this.holds }),
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
            if (!wanted.has(name)) await this.again(() => fetch(address(id, name), { method: "DELETE" }));
        }
    }

    async sendAll(items, addressOf, arrived) {
        this.items = items;
        this.finished = 0;
        const waiting = [...items];
        this.report("sending");
        const work = async () => {
            for (let item = waiting.shift(); item; item = waiting.shift()) {
                const sha256 = await this.digest(item.file);
                if (arrived.get(item.name)?.sha256 !== hex(sha256)) await this.again(() => this.put(addressOf(item), item, sha256));
                this.sent.set(item.name, item.file.size);
                this.finished += 1;
                this.report("sending");
            }
        };
        try {
            await Promise.all(Array.from({ length: PARALLEL }, work));
        } catch (error) {
            waiting.length = 0;
            this.running.forEach((request) => request.abort());
            throw error;
        }
    }

    put(url, { name, file }, sha256) {
        return new Promise((resolve, reject) => {
            const request = new XMLHttpRequest(); // fetch does not tell how much has gone out
            this.running.add(request);
            request.open("PUT", url);
            request.setRequestHeader("Content-Type", "application/octet-stream");
            request.setRequestHeader("Repr-Digest", `sha-256=:${base64(sha256)}:`);
            request.upload.onprogress = ({ loaded }) => {
                this.sent.set(name, loaded);
                this.report("sending");
            };
            request.onload = () => answer(new Response(request.responseText || "{}", { status: request.status })).then(resolve, (error) => {
                error.faults = error.faults?.length ? error.faults : [`${name}: ${error.message}`];
                reject(error);
            });
            request.onerror = request.onabort = () => reject(new TypeError("The connection broke off."));
            request.onloadend = () => {
                this.running.delete(request);
                if (request.status < 200 || request.status > 299) this.sent.delete(name);
            };
            request.send(file);
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

function hex(bytes) {
    return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

function base64(bytes) {
    return btoa(String.fromCharCode(...bytes));
}
