// The viewer of a mesh on a job's page.

import { OrbitControls, PerspectiveCamera, Vector3 } from "../vendor/three.js";
import { thousands } from "../numbers.js";
import { LoadingViewer } from "./loading_viewer.js";
import { MeshRenderer } from "./meshes.js";

const MAX_PIXEL_RATIO = 2;
const BACKGROUNDS = [[0, 0, 0], [1, 1, 1]];
const START = new Vector3(0.5, 0.4, 1).normalize();
const FOV = 45;

class MeshViewer extends LoadingViewer {
    constructor(box) {
        super(box);
        this.background = 0;
        this.startOrAsk();
    }

    async start() {
        this.say("Loading the mesh");
        try {
            try {
                this.meshes = new MeshRenderer(this.canvas);
            } catch {
                throw new Error("This browser has no WebGL 2, so the mesh cannot be shown here; the downloads open elsewhere.");
            }
            this.setUp(await this.meshes.load(this.box.dataset.mesh, (loaded) => this.say(`Loading the mesh: ${(loaded / 1e6).toFixed(1)} MB`)));
        } catch (error) {
            this.veil.hidden = false;
            this.say(error.message);
            this.box.dataset.ready = "failed";
        }
    }

    setUp({ center, radius, triangles }) {
        this.center = center;
        this.radius = radius;
        this.camera = new PerspectiveCamera(FOV, 1, radius * 1e-3, radius * 100);
        this.controls = new OrbitControls(this.camera, this.canvas);
        this.controls.addEventListener("change", () => this.draw());
        this.controls.listenToKeyEvents(this.canvas);
        const tools = this.box.querySelector(".tools");
        tools.hidden = false;
        tools.addEventListener("click", ({ target }) => target.dataset.do && this.do(target.dataset.do));
        tools.querySelector("[data-do=full]").hidden = !document.fullscreenEnabled;
        tools.querySelector(".count").textContent = `${thousands(triangles)} triangles`;
        new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
        this.do("reset");
        this.resize();
        this.veil.hidden = true;
        this.box.dataset.ready = "yes";
    }

    do(action) {
        if (action === "background") this.background = 1 - this.background;
        else if (action === "full") {
            if (document.fullscreenElement) document.exitFullscreen();
            else this.box.requestFullscreen();
        } else if (action === "reset") {
            const distance = (1.1 * this.radius) / Math.sin((FOV * Math.PI) / 360);
            this.camera.position.copy(this.center).addScaledVector(START, distance);
            this.controls.target.copy(this.center);
            this.controls.update();
        }
        this.draw();
    }

    resize() {
        const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
        if (!width || !height) return;
        this.meshes.setSize(width, height, Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
        this.camera.aspect = width / height;
        this.camera.updateProjectionMatrix();
        this.draw();
    }

    draw() {
        this.meshes.setBackground(...BACKGROUNDS[this.background]);
        this.meshes.render(this.camera, this.controls.target);
    }
}

const box = document.getElementById("mesh-viewer");
if (box) new MeshViewer(box);
