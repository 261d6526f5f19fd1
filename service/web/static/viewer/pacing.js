// How much is drawn at once: less while frames take long, all of it once the camera rests.

const WANTED_MS = 60;
const MAX_MS = 80;
const LEAST_SCALE = 0.25;
const LEAST_COUNT = 3000;
const FIRST_SCALE = 0.5, FIRST_COUNT = 20_000;
const FIRST_SLICE = 10_000, LEAST_SLICE = 500;

/** Adapts the share of the pixels and of the Gaussians to how long frames take. */
export class Pacing {
    constructor(count) {
        this.count = count;
        this.limit = Math.min(count, FIRST_COUNT);
        this.scale = FIRST_SCALE;
        this.slice = FIRST_SLICE;
    }

    /** A frame of a moving camera took so long: fewer pixels help first, then fewer Gaussians. */
    noteFrame(milliseconds) {
        const share = WANTED_MS / Math.max(1, milliseconds);
        if (milliseconds > MAX_MS) {
            const scale = Math.max(LEAST_SCALE, this.scale * Math.sqrt(share));
            const left = share * (this.scale / scale) ** 2;
            this.scale = scale;
            if (left < 0.9) this.limit = Math.max(LEAST_COUNT, Math.round(this.limit * Math.max(0.2, left)));
        } else if (share > 1.5) {
            const more = Math.min(2, share / 1.2);
            if (this.limit < this.count) this.limit = Math.min(this.count, Math.round(this.limit * more));
            else this.scale = Math.min(1, this.scale * Math.sqrt(more));
        }
    }

    /** A part of the picture of a resting camera took so long. */
    noteSlice(milliseconds) {
        const share = WANTED_MS / Math.max(1, milliseconds);
        this.slice = Math.max(LEAST_SLICE, Math.round(this.slice * Math.min(4, Math.max(0.3, share))));
    }
}
