// Previews: a job of a moment, whose picture is shown and which is deleted then.

import { answer } from "./options.js";

const LOOK_MS = 300;
const api = (path, method = "GET") => fetch(`/v1/jobs/${path}`, { method });

/** What went wrong, each sentence once. */
export const sentences = (error) => [...new Set([error.message, ...(error.faults ?? [])])].join(" ");

/** The previews of a section, of which the newest counts. */
export class Trials {
    /**
     * @param section holds `figure.preview`, `.light-state` and `.fault`
     */
    constructor(section) {
        this.section = section;
        this.newest = null;
    }

    say(words) { this.section.querySelector(".light-state").textContent = words; }

    complain(words) {
        const fault = this.section.querySelector(".fault");
        fault.textContent = words;
        fault.hidden = !words;
    }

    /**
     * One small picture with few samples; the job goes when its picture is here.
     * @param queue queues the job; gives its id
     * @param name of the view
     * @param what the picture shows
     * @param about it, below it
     */
    async show(queue, name, what, about) {
        const mine = this.newest = { id: null };
        const began = performance.now();
        this.complain("");
        this.say("Asking for a preview …");
        this.section.setAttribute("aria-busy", "true");
        try {
            mine.id = await queue();
            const picture = await this.finished(mine) && await this.picture(mine.id);
            if (picture && mine === this.newest) {
                this.showPicture(picture, `Preview of ${name} ${what}`, `${name}, ${about}`);
                this.say(`The preview took ${Math.round((performance.now() - began) / 1000)} s.`);
            }
        } catch (error) {
            if (mine === this.newest) {
                this.say("");
                this.complain(sentences(error));
            }
        } finally {
            if (mine.id) forget(mine.id);
            if (mine === this.newest) this.section.removeAttribute("aria-busy");
        }
    }

    /** Waits for a job; null if another preview was asked for meanwhile. */
    async finished(mine) {
        for (;;) {
            if (mine !== this.newest) return null;
            const job = await api(mine.id).then(answer);
            if (job.state === "succeeded") return job;
            if (job.state === "failed") throw new Error(job.error.message);
            if (job.state === "canceled") throw new Error("The preview was cancelled.");
            if (job.state === "running") this.say("Rendering a preview …");
            else this.say(job.notes[0] ?? (job.queue_position ? `Waiting: ${job.queue_position} before it.` : "Waiting for a worker …"));
            await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
        }
    }

    /** The picture that a job made. */
    async picture(id) {
        const { artifacts } = await api(`${id}/artifacts`).then(answer);
        const found = artifacts.find((artifact) => artifact.name.endsWith(".png"));
        if (!found) throw new Error("The preview made no picture.");
        const response = await api(`${id}/artifacts/${found.name.split("/").map(encodeURIComponent).join("/")}`);
        return response.ok ? response.blob() : answer(response);
    }

    showPicture(content, alt, caption) {
        const figure = this.section.querySelector("figure.preview"), image = figure.querySelector("img");
        if (image.src) URL.revokeObjectURL(image.src);
        image.src = URL.createObjectURL(content);
        image.alt = alt;
        figure.querySelector("figcaption").textContent = caption;
        figure.hidden = false;
    }
}

/** Deletes a job that nobody needs any more, stopped first if it is not over. */
async function forget(id) {
    for (let tries = 0; tries < 10; tries++) {
        const gone = await api(`${id}?cancel=true`, "DELETE").catch(() => null);
        if (gone && (gone.ok || [401, 403, 404].includes(gone.status))) return;
        await new Promise((resolve) => setTimeout(resolve, 2000));
    }
}
