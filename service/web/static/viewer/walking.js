// Keys, and flying: what OrbitControls leaves out.

import { Vector3 } from "../vendor/three.js";

const TURN_PER_SECOND = 1.1;
const LOOK_PER_PIXEL = 0.004;
const ACTIONS = { n: "next", p: "previous", r: "reset", f: "toggle-fly", b: "background", l: "materials", k: "key", c: "cameras", m: "measure" };
const HELD = new Set(["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE", "ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Equal", "Minus", "NumpadAdd", "NumpadSubtract"]);

const BY_SIGN = { "+": "Equal", "=": "Equal", "-": "Minus", "\u2212": "Minus" };

/** What a key that is held does: those that lie as W A S D go by their place, others by what is on them. */
const heldName = ({ key, code }) => BY_SIGN[key] ?? (HELD.has(code) ? code : null);

/** What a key that is pressed does: by its letter, or where that is no Latin one, by its place. */
const actionOf = ({ key, code }) => ACTIONS[(/^[a-z]$/i.test(key) ? key : code.replace(/^Key/, "")).toLowerCase()];

/** Moves a camera by keys, and turns it on the spot by dragging while it flies. */
export class Walking {
    constructor(canvas, camera, controls, radius, act, wake) {
        Object.assign(this, { canvas, camera, controls, radius, wake });
        this.flying = false;
        this.keys = new Set();
        this.names = new Map(); // of what is held, by the key that holds it
        // A tap that is shorter than a frame counts as well: its key goes with the next step.
        this.fresh = new Set();
        this.tapped = new Set();
        this.fast = false;
        this.distance = radius;
        canvas.addEventListener("keydown", (event) => {
            if (event.ctrlKey || event.metaKey || event.altKey) return;
            this.fast = event.shiftKey;
            const held = heldName(event), action = actionOf(event);
            if (held) {
                if (!this.keys.has(held)) this.fresh.add(held);
                this.keys.add(held);
                this.names.set(event.code, held);
                event.preventDefault();
                wake();
            } else if (action && !event.repeat) act(action);
        });
        canvas.addEventListener("keyup", (event) => {
            this.fast = event.shiftKey;
            const held = this.names.get(event.code);
            if (this.fresh.has(held)) this.tapped.add(held);
            else this.keys.delete(held);
        });
        canvas.addEventListener("blur", () => [this.keys, this.fresh, this.tapped].forEach((keys) => keys.clear()));
        canvas.addEventListener("pointermove", (event) => this.drag(event));
        canvas.addEventListener("wheel", (event) => {
            if (!this.flying) return;
            event.preventDefault();
            this.move(new Vector3(0, 0, -Math.sign(event.deltaY)), 0.08 * this.radius);
        }, { passive: false });
    }

    setFlying(flying) {
        if (flying === this.flying) return;
        this.flying = flying;
        this.controls.enabled = !flying;
        if (flying) this.distance = this.camera.position.distanceTo(this.controls.target);
        else this.aim();
    }

    /** Puts what orbiting turns about in front of the camera. */
    aim() {
        const forward = this.camera.getWorldDirection(new Vector3());
        this.controls.target.copy(this.camera.position).addScaledVector(forward, this.distance);
    }

    drag(event) {
        if (!this.flying || !(event.buttons & 1)) return;
        this.look(-event.movementX * LOOK_PER_PIXEL, -event.movementY * LOOK_PER_PIXEL);
        this.wake();
    }

    /** Turns the camera on the spot: to the left and upwards, radians. */
    look(left, upwards) {
        const up = this.camera.up;
        const forward = this.camera.getWorldDirection(new Vector3());
        const right = new Vector3().crossVectors(forward, up).normalize();
        forward.applyAxisAngle(up, left);
        const tilted = forward.clone().applyAxisAngle(right.applyAxisAngle(up, left), upwards);
        if (Math.abs(tilted.dot(up)) < 0.995) forward.copy(tilted);
        this.camera.lookAt(this.camera.position.clone().add(forward));
        this.aim();
    }

    /** Turns the camera about the target: to the left and upwards, radians. */
    orbit(left, upwards) {
        const { camera, controls } = this;
        const offset = camera.position.clone().sub(controls.target);
        const right = new Vector3().crossVectors(offset, camera.up).normalize().negate();
        offset.applyAxisAngle(camera.up, -left);
        const tilted = offset.clone().applyAxisAngle(right.applyAxisAngle(camera.up, -left), -upwards);
        if (Math.abs(tilted.clone().normalize().dot(camera.up)) < 0.995) offset.copy(tilted);
        camera.position.copy(controls.target).add(offset);
        camera.lookAt(controls.target);
    }

    /** Moves camera and target: `where` is to the right, upwards and forward in the camera's frame. */
    move(where, length) {
        const forward = this.camera.getWorldDirection(new Vector3());
        const right = new Vector3().crossVectors(forward, this.camera.up).normalize();
        const step = right.multiplyScalar(where.x).addScaledVector(this.camera.up, where.y).addScaledVector(forward, where.z).multiplyScalar(length);
        this.camera.position.add(step);
        this.controls.target.add(step);
        this.wake();
    }

    /** What the held keys do in `seconds`; whether they do anything. */
    step(seconds) {
        if (!this.keys.size) return false;
        const axis = (plus, minus) => (this.keys.has(plus) ? 1 : 0) - (this.keys.has(minus) ? 1 : 0);
        const speed = this.radius * seconds * (this.fast ? 2 : 0.6);
        const where = new Vector3(axis("KeyD", "KeyA"), axis("KeyE", "KeyQ"), axis("KeyW", "KeyS"));
        if (where.lengthSq() > 0) this.move(where, speed);
        const left = axis("ArrowLeft", "ArrowRight") * TURN_PER_SECOND * seconds, upwards = axis("ArrowUp", "ArrowDown") * TURN_PER_SECOND * seconds;
        if (left || upwards) {
            if (this.flying) this.look(left, upwards);
            else this.orbit(left, upwards);
        }
        const nearer = axis("Equal", "Minus") + axis("NumpadAdd", "NumpadSubtract");
        if (nearer && this.flying) this.move(new Vector3(0, 0, nearer), speed);
        else if (nearer) {
            const offset = this.camera.position.clone().sub(this.controls.target).multiplyScalar(Math.exp(-nearer * 1.5 * seconds));
            this.camera.position.copy(this.controls.target).add(offset);
        }
        this.tapped.forEach((key) => this.keys.delete(key));
        this.fresh.clear();
        this.tapped.clear();
        this.wake();
        return true;
    }
}
