// Lines and marks over the 3D view, on a canvas of their own: cameras, a box, a distance, notes.

import { Vector3 } from "../vendor/three.js";

const FRUSTUM_DEPTH = 0.08; // of the radius
const MAX_FRUSTA = 400;
const EDGES = [[0, 1], [1, 3], [3, 2], [2, 0], [4, 5], [5, 7], [7, 6], [6, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

export class Overlay {
    constructor(canvas) {
        this.canvas = canvas;
        this.context = canvas.getContext("2d");
        this.frusta = null; // [{corners, heldOut}], while they are shown
        this.box = null; // [x0, y0, z0, x1, y1, z1]
        this.segment = []; // up to two points
        this.label = "";
        this.notes = []; // [{position, text}]
        this.chosen = -1; // number of the view that the camera is at
        this.a = new Vector3();
        this.b = new Vector3();
    }

    /** Shows the cameras of views as of cameras.json, or none. */
    showFrusta(views, radius) {
        this.frusta = views && views.slice(0, MAX_FRUSTA).map((view) => frustumOf(view, FRUSTUM_DEPTH * radius));
    }

    setSize(width, height, ratio) {
        Object.assign(this, { width, height, ratio });
        this.canvas.width = Math.round(width * ratio);
        this.canvas.height = Math.round(height * ratio);
    }

    draw(camera) {
        const { context } = this;
        context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
        context.clearRect(0, 0, this.width, this.height);
        camera.updateMatrixWorld();
        if (this.frusta) this.drawFrusta(camera);
        if (this.box) this.drawBox(camera);
        if (this.segment.length) this.drawSegment(camera);
        this.notes.forEach((note, k) => this.drawNote(camera, note, k + 1));
    }

    drawFrusta(camera) {
        for (const heldOut of [false, true]) {
            this.begin(heldOut ? "#ffb020" : "#4da3ff", 1);
            this.frusta.forEach((frustum, k) => {
                if (frustum.heldOut !== heldOut || k === this.chosen) return;
                if (this.a.fromArray(frustum.corners[0]).distanceTo(camera.position) < frustum.depth) return; // it would fill the view
                const [centre, ...corners] = frustum.corners;
                corners.forEach((corner, c) => {
                    this.line(camera, centre, corner);
                    this.line(camera, corner, corners[(c + 1) % 4]);
                });
            });
            this.context.stroke();
        }
    }

    drawBox(camera) {
        const [x0, y0, z0, x1, y1, z1] = this.box;
        const corners = Array.from({ length: 8 }, (_, k) => [k & 1 ? x1 : x0, k & 2 ? y1 : y0, k & 4 ? z1 : z0]);
        this.begin("#ffd84d", 2);
        for (const [from, to] of EDGES) this.line(camera, corners[from], corners[to]);
        this.context.stroke();
    }

    drawSegment(camera) {
        const [first, second] = this.segment;
        if (second) {
            this.begin("#ff5ca8", 2);
            this.line(camera, first, second);
            this.context.stroke();
        }
        for (const point of this.segment) this.dot(this.at(camera, point), "#ff5ca8", 5);
        const place = second && this.at(camera, second.map((value, k) => (value + first[k]) / 2));
        if (place) this.text(place, this.label);
    }

    drawNote(camera, { position }, number) {
        const place = this.at(camera, position);
        if (!place) return;
        this.dot(place, "#1d6fd1", 10);
        this.context.fillStyle = "#fff";
        this.context.font = "600 12px system-ui, sans-serif";
        this.context.textAlign = "center";
        this.context.textBaseline = "middle";
        this.context.fillText(String(number), ...place);
    }

    begin(color, width) {
        Object.assign(this.context, { strokeStyle: color, lineWidth: width });
        this.context.beginPath();
    }

    dot(place, color, radius) {
        if (!place) return;
        this.context.beginPath();
        this.context.arc(...place, radius, 0, 2 * Math.PI);
        Object.assign(this.context, { fillStyle: color, strokeStyle: "#fff", lineWidth: 1.5 });
        this.context.fill();
        this.context.stroke();
    }

    text(place, words) {
        this.context.font = "600 13px system-ui, sans-serif";
        const half = this.context.measureText(words).width / 2 + 6;
        this.context.fillStyle = "#000c";
        this.context.fillRect(place[0] - half, place[1] - 11, 2 * half, 22);
        Object.assign(this.context, { fillStyle: "#fff", textAlign: "center", textBaseline: "middle" });
        this.context.fillText(words, ...place);
    }

    /** Where a point lies on the screen, px; null behind the camera. */
    at(camera, point) {
        this.a.fromArray(point).applyMatrix4(camera.matrixWorldInverse);
        if (this.a.z > -camera.near) return null;
        this.a.applyMatrix4(camera.projectionMatrix);
        return [((1 + this.a.x) / 2) * this.width, ((1 - this.a.y) / 2) * this.height];
    }

    /** Adds a line to the path, cut off where it goes behind the camera. */
    line(camera, from, to) {
        const near = -camera.near * 1.01;
        this.a.fromArray(from).applyMatrix4(camera.matrixWorldInverse);
        this.b.fromArray(to).applyMatrix4(camera.matrixWorldInverse);
        if (this.a.z > near && this.b.z > near) return;
        if (this.a.z > near) this.a.lerp(this.b, (this.a.z - near) / (this.a.z - this.b.z));
        else if (this.b.z > near) this.b.lerp(this.a, (this.b.z - near) / (this.b.z - this.a.z));
        for (const [end, go] of [[this.a, "moveTo"], [this.b, "lineTo"]]) {
            end.applyMatrix4(camera.projectionMatrix);
            this.context[go](((1 + end.x) / 2) * this.width, ((1 - end.y) / 2) * this.height);
        }
    }
}

/** The camera's place and the four corners of its image at a depth. */
function frustumOf({ position, forward, up, fov_y_degrees: fovY, aspect, held_out: heldOut }, depth) {
    const f = new Vector3().fromArray(forward), u = new Vector3().fromArray(up), r = new Vector3().crossVectors(f, u);
    const high = depth * Math.tan((fovY * Math.PI) / 360), wide = high * aspect;
    const corner = (x, y) => new Vector3().fromArray(position).addScaledVector(f, depth).addScaledVector(r, x * wide).addScaledVector(u, y * high).toArray();
    return { heldOut, depth, corners: [position, corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)] };
}
