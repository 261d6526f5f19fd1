// Cameras that a person collects in the viewer, saved as the file that `octasplat render --path` takes.

const HEIGHT_PX = 720;
const FPS = 30;
const SECONDS_BETWEEN = 2;

export class CameraPath {
    constructor() {
        this.keys = [];
    }

    /** Adds where a camera stands now; returns how many there are. */
    add(camera) {
        camera.updateMatrixWorld(true);
        const m = camera.matrixWorld.elements;
        // Ours look along +z with y down, those of three.js along -z with y up.
        const row = (k) => [m[k], -m[4 + k], -m[8 + k], m[12 + k]];
        this.aspect = camera.aspect;
        return this.keys.push({ camera_to_world: [row(0), row(1), row(2), [0, 0, 0, 1]], fov_y_degrees: camera.fov });
    }

    clear() {
        this.keys = [];
    }

    /** The file's content: a smooth path through the keys, or the only one as a still. */
    content() {
        const size = { width: 2 * Math.round((HEIGHT_PX * this.aspect) / 2), height: HEIGHT_PX, fps: FPS };
        if (this.keys.length === 1) return { ...size, frames: this.keys };
        return { ...size, seconds: SECONDS_BETWEEN * (this.keys.length - 1), ease: "in-out", keys: this.keys };
    }

    /** Hands the file to the browser to be saved. */
    save(name) {
        const address = URL.createObjectURL(new Blob([JSON.stringify(this.content(), null, 1)], { type: "application/json" }));
        Object.assign(document.createElement("a"), { href: address, download: name }).click();
        setTimeout(() => URL.revokeObjectURL(address), 1000);
    }
}
