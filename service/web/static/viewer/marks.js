// Points that are clicked in the 3D view: a distance between two of them, and notes that are kept with the job.

import { Vector3 } from "../vendor/three.js";

const CLICK_PX = 5;
const TRIES = 5;

const same = (one, other) => one.text === other.text && String(one.position) === String(other.position);

export class Marks {
    /** @param viewer has the box, canvas, camera, controls, overlay, pick(x, y), wake(), goTo(position, target). */
    constructor(viewer) {
        this.viewer = viewer;
        this.mode = null; // "measure" or "note"
        const { box, canvas } = viewer;
        this.form = box.querySelector(".note-form");
        this.list = box.querySelector(".view-notes");
        this.notes = JSON.parse(box.dataset.notes || "[]");
        let down = null;
        canvas.addEventListener("pointerdown", (event) => { down = [event.offsetX, event.offsetY]; });
        canvas.addEventListener("pointerup", (event) => {
            const isClick = down && Math.hypot(event.offsetX - down[0], event.offsetY - down[1]) < CLICK_PX;
            if (this.mode && isClick && event.button === 0) this.take(event.offsetX, event.offsetY);
        });
        canvas.addEventListener("keydown", (event) => {
            if (this.mode && event.key === "Enter") this.take(canvas.clientWidth / 2, canvas.clientHeight / 2);
            if (this.mode && event.key === "Escape") this.toggle(this.mode);
        });
        this.form.addEventListener("submit", (event) => {
            event.preventDefault();
            this.keep();
        });
        this.form.querySelector("[data-do=note-cancel]").addEventListener("click", () => {
            this.form.hidden = true;
            canvas.focus({ preventScroll: true });
        });
        this.showNotes();
    }

    toggle(mode) {
        this.mode = this.mode === mode ? null : mode;
        const { box, overlay, canvas, place } = this.viewer;
        for (const name of ["measure", "note"]) box.querySelector(`[data-do=${name}]`)?.setAttribute("aria-pressed", String(this.mode === name));
        canvas.classList.toggle("picking", this.mode !== null);
        overlay.segment = [];
        place.textContent = this.mode === "measure" ? "Click two points." : this.mode === "note" ? "Click a point." : "";
        this.form.hidden = true;
        this.viewer.wake();
    }

    async take(x, y) {
        const { overlay, place, box } = this.viewer;
        const mode = this.mode, point = await this.viewer.pick(x, y);
        if (mode !== this.mode) return; // something else is wanted since
        if (!point) {
            place.textContent = "Nothing is there.";
            return;
        }
        if (mode === "note") {
            this.point = point;
            this.form.hidden = false;
            this.form.querySelector("input").focus();
            return;
        }
        if (overlay.segment.length === 2) overlay.segment = [];
        overlay.segment.push(point);
        if (overlay.segment.length === 2) {
            const distance = Math.hypot(...point.map((value, k) => value - overlay.segment[0][k]));
            overlay.label = distance.toPrecision(4);
            place.textContent = `Distance ${overlay.label} in the scene's units`;
            box.dataset.distance = String(distance);
        } else place.textContent = "Click the second point.";
        this.viewer.wake();
    }

    async keep() {
        const { camera, controls } = this.viewer;
        const input = this.form.querySelector("input"), button = this.form.querySelector("[type=submit]");
        if (button.disabled || !input.value.trim()) return;
        button.disabled = true; // pressed twice, it would be kept twice
        const note = { text: input.value.trim(), position: this.point, camera: [...camera.position.toArray(), ...controls.target.toArray()] };
        const isKept = await this.store((notes) => [...notes, note]);
        button.disabled = false;
        if (!isKept) return;
        input.value = "";
        this.form.hidden = true;
        if (this.mode === "note") this.toggle("note");
        this.viewer.canvas.focus({ preventScroll: true });
    }

    /** Changes the notes that the job has by now: others may have written some since this page was loaded. */
    async store(change) {
        const { box, place } = this.viewer;
        const address = `/v1/jobs/${box.dataset.job}`;
        let response = null;
        for (let left = TRIES; left > 0 && (response === null || response.status === 412); left -= 1) {
            response = await fetch(address).catch(() => null);
            if (!response?.ok) break;
            const { view_notes: notes } = await response.json();
            response = await fetch(address, {
                method: "PATCH",
                headers: { "Content-Type": "application/json", "If-Match": response.headers.get("ETag") },
                body: JSON.stringify({ view_notes: change(notes) }),
            }).catch(() => null);
            if (response === null) break;
        }
        const answered = await response?.json().catch(() => null);
        if (response?.ok) this.notes = answered.view_notes;
        else place.textContent = answered?.detail ?? "The note was not kept.";
        this.showNotes();
        return Boolean(response?.ok);
    }

    showNotes() {
        const mayChange = this.viewer.box.querySelector("[data-do=note]") !== null;
        this.viewer.overlay.notes = this.notes;
        this.list.hidden = !this.notes.length;
        this.list.replaceChildren(...this.notes.map((note) => {
            const item = document.createElement("li");
            const go = Object.assign(document.createElement("button"), { type: "button", className: "plain", textContent: note.text, title: "Look at it" });
            go.addEventListener("click", () => this.viewer.goTo(note.camera.slice(0, 3), new Vector3().fromArray(note.camera, 3)));
            item.append(go);
            if (mayChange) {
                const remove = Object.assign(document.createElement("button"), { type: "button", className: "plain", textContent: "×" });
                remove.setAttribute("aria-label", `Remove the note ${note.text}`);
                remove.addEventListener("click", () => this.store((notes) => notes.filter((other) => !same(note, other))));
                item.append(" ", remove);
            }
            return item;
        }));
        this.viewer.wake();
    }
}
