// The form of crop and clean: what they would do is shown in the 3D view, and then asked for as a job.

import { thousands } from "../numbers.js";
import { queueJob } from "../options.js";

const PAUSE_MS = 200;
const WIDEST = 0.005, USUAL = 0.05; // shares of the Gaussians beyond the sliders' ends, and beyond the first box
const WORDS = { outside: "outside the box", faint: "too faint", large: "too large", near: "too near to a camera", unseen: "beyond what the cameras see", floating: "floating" };

export class EditPanel {
    constructor(panel, viewer) {
        this.viewer = viewer;
        this.form = panel.querySelector("form");
        this.state = panel.querySelector(".edit-state");
        this.source = panel.dataset.source;
        this.origin = JSON.parse(panel.dataset.origin);
        this.usual = JSON.parse(panel.dataset.clean);
        this.show = "kept";
        panel.hidden = false;
        this.setBox(viewer.scene);
        this.form.addEventListener("input", () => this.soon());
        viewer.box.addEventListener("edited", ({ detail }) => this.tell(detail));
        for (const button of panel.querySelectorAll("[data-show]")) {
            button.addEventListener("click", () => {
                this.show = button.dataset.show;
                panel.querySelectorAll("[data-show]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
                this.ask();
            });
        }
        panel.addEventListener("toggle", () => this.ask());
        this.panel = panel;
        this.form.addEventListener("submit", (event) => {
            event.preventDefault();
            this.queue(event.submitter.value);
        });
    }

    /** Sliders from end to end of the scene, and a first box about most of it. */
    setBox({ count, geometry }) {
        "xyz".split("").forEach((axis, k) => {
            const values = Float32Array.from({ length: count }, (_, i) => geometry[12 * i + k]).sort();
            const at = (share) => values[Math.min(count - 1, Math.floor(share * count))];
            const low = at(WIDEST), high = at(1 - WIDEST);
            for (const [side, value] of [["low", at(USUAL)], ["high", at(1 - USUAL)]]) {
                const input = this.form.elements[`${axis}_${side}`];
                Object.assign(input, { min: low, max: high, step: (high - low) / 500 || 1 });
                input.value = value;
            }
        });
        this.showNumbers();
    }

    showNumbers() {
        for (const output of this.form.querySelectorAll("output")) {
            const input = document.getElementById(output.htmlFor.value), axis = "xyz".indexOf(input.name[0]);
            output.textContent = (Number(input.value) + this.origin[axis]).toFixed(decimalsOf(Number(input.step)));
        }
    }

    /** {box, clean}: what is ticked. */
    wanted() {
        const field = (name) => this.form.elements[name];
        const box = field("crop").checked ? ["low", "high"].flatMap((side) => "xyz".split("").map((axis) => Number(field(`${axis}_${side}`).value))) : null;
        const clean = field("clean").checked ? {
            ...this.usual, min_opacity: Number(field("min_opacity").value), max_scale: Number(field("max_scale").value) || null,
            min_views: Number(field("min_views").value), min_group: Number(field("min_group").value), floaters: field("floaters").checked,
        } : null;
        return { box, clean };
    }

    soon() {
        clearTimeout(this.timer);
        this.timer = setTimeout(() => this.ask(), PAUSE_MS);
        const { box, clean } = this.wanted();
        this.form.querySelector(".box-sliders").hidden = !box;
        this.form.querySelector(".clean-fields").hidden = !clean;
        // What is not asked for keeps nothing from being asked for, whatever it says.
        this.form.querySelectorAll(".clean-fields input").forEach((field) => { field.disabled = !clean; });
        this.form.querySelector("[value=crop]").disabled = !box;
        this.form.querySelector("[value=clean]").disabled = !clean;
        const region = this.form.querySelector("#edit-region"); // not there for results of other jobs
        if (region) {
            region.hidden = !box;
            if (box) region.href = `${region.dataset.new}#region=${this.inText(box).join(",")}`;
        }
        this.viewer.overlay.box = box;
        this.showNumbers();
        this.viewer.wake();
    }

    ask() {
        const { box, clean } = this.wanted(), isOpen = this.panel.open && (box || clean);
        this.viewer.overlay.box = isOpen ? box : null;
        const wrong = isOpen && this.form.querySelector("input:invalid");
        if (wrong) {
            this.state.textContent = `${wrong.labels[0].textContent}: ${wrong.validationMessage}`;
            return;
        }
        if (isOpen) this.state.textContent = "Looking …";
        this.viewer.edit(isOpen ? { box, clean } : { box: null, clean: null }, isOpen ? this.show : "all");
    }

    /** A box in the coordinates of the user. */
    inFile(box) {
        return box.map((value, k) => value + this.origin[k % 3]);
    }

    /** The same as text, each number as fine as its slider moves, however far the scene is from the origin. */
    inText(box) {
        const step = (k) => Number(this.form.elements[`${"xyz"[k % 3]}_low`].step);
        return this.inFile(box).map((value, k) => value.toFixed(decimalsOf(step(k) / 10)));
    }

    tell({ counts, kept, error }) {
        if (error) {
            this.state.textContent = `What this would do cannot be shown here (${error}); a job can do it.`;
            return;
        }
        const reasons = Object.entries(counts).filter(([, number]) => number).map(([reason, number]) => `${thousands(number)} ${WORDS[reason]}`);
        this.state.textContent = `${thousands(kept)} Gaussians stay${reasons.length ? `; ${reasons.join(", ")}` : ""}.`;
        this.viewer.box.dataset.edited = JSON.stringify({ ...counts, kept });
    }

    async queue(kind) {
        if (this.isQueuing) return; // pressed twice, there would be two jobs
        const { box, clean } = this.wanted(), fault = this.form.querySelector(".fault");
        fault.hidden = this.isQueuing = true;
        const options = kind === "crop" ? { box: this.inFile(box) } : clean;
        try {
            location.href = `/jobs/${await queueJob({ kind, source_id: this.source, options }, crypto.randomUUID?.() ?? String(Math.random()))}`;
        } catch (error) {
            fault.textContent = [error.message, ...(error.faults ?? [])].join(" ");
            fault.hidden = this.isQueuing = false;
        }
    }
}

/** Digits behind the point that tell one step of a slider from the next. */
function decimalsOf(step) {
    return Math.min(20, Math.max(0, Math.ceil(-Math.log10(step))));
}
