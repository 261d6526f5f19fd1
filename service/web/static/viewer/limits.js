// Where a camera may go: around where photographs were taken, so that it never ends behind what they show.

import { Vector3 } from "../vendor/three.js";

const SLACK_RADIANS = (20 * Math.PI) / 180;
const FARTHEST = 1.25, NEAREST = 0.25; // of the distance of the photograph in that direction
const TARGET_REACH = 1.5; // of the radius, from the middle

/** Limits from photographs as of cameras.json; without any, nothing is limited. */
export class Limits {
    constructor({ views, target, radius }) {
        this.middle = new Vector3().fromArray(target);
        this.radius = radius;
        this.places = views.map((view) => {
            const away = new Vector3().fromArray(view.position).sub(this.middle);
            const distance = away.length();
            return { direction: away.divideScalar(distance || 1), distance };
        });
        this.farthest = Math.max(...this.places.map(({ distance }) => distance), 0);
        this.offset = new Vector3();
        this.axis = new Vector3();
    }

    /** Moves a camera's place to the nearest allowed one; whether it had left. */
    clamp(position) {
        if (!this.places.length) return false;
        const { offset, axis } = this;
        offset.copy(position).sub(this.middle);
        const distance = offset.length();
        if (distance > 0) offset.divideScalar(distance);
        else offset.copy(this.places[0].direction);
        let nearest = this.places[0], cosine = -Infinity;
        for (const place of this.places) {
            const dot = place.direction.dot(offset);
            if (dot > cosine) [nearest, cosine] = [place, dot];
        }
        const angle = Math.acos(Math.min(1, Math.max(-1, cosine)));
        const far = FARTHEST * nearest.distance + 0.02 * this.radius, near = NEAREST * nearest.distance;
        const allowed = Math.min(far, Math.max(near, distance));
        if (angle <= SLACK_RADIANS && allowed === distance) return false;
        if (angle > SLACK_RADIANS) {
            axis.crossVectors(nearest.direction, offset);
            if (axis.lengthSq() < 1e-12) axis.crossVectors(nearest.direction, Math.abs(nearest.direction.x) < 0.9 ? new Vector3(1, 0, 0) : new Vector3(0, 1, 0));
            offset.copy(nearest.direction).applyAxisAngle(axis.normalize(), SLACK_RADIANS);
        }
        position.copy(this.middle).addScaledVector(offset, allowed);
        return true;
    }

    /** Keeps what a camera turns about near the middle. */
    clampTarget(target) {
        if (!this.places.length) return;
        this.offset.copy(target).sub(this.middle);
        const reach = TARGET_REACH * Math.max(this.radius, this.farthest);
        if (this.offset.length() > reach) target.copy(this.middle).addScaledVector(this.offset.normalize(), reach);
    }
}
