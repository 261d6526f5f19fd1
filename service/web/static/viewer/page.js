// The viewer on a job's page: loads the scene, starts from the photographs' cameras, listens to all controls.

import { OrbitControls, PerspectiveCamera, Vector3 } from "../vendor/three.js";
import { CameraPath } from "./camera_path.js";
import { EditPanel } from "./edit_panel.js";
import { readHdr } from "./environment.js";
import { Limits } from "./limits.js";
import { Marks } from "./marks.js";
import { Overlay } from "./overlay.js";
import { Pacing } from "./pacing.js";
import { Photograph } from "./photograph.js";
import { linkOf, viewOf } from "./view_link.js";
import { Walking } from "./walking.js";
import { CHI2_2_99, Sorting, SplatRenderer } from "./splats.js";
import { thousands } from "../numbers.js";
import { LoadingViewer } from "./loading_viewer.js";

const MAX_PIXEL_RATIO = 2;
const REST_MS = 150;
const CAMERA_TRIES = 3, CAMERA_PAUSE_MS = 500;
const BACKGROUNDS = { black: [0, 0, 0], white: [1, 1, 1] };

class Viewer extends LoadingViewer {
    constructor(box) {
        super(box);
        this.place = box.querySelector(".place");
        this.q = Number(box.dataset.q) || CHI2_2_99;
        this.background = box.dataset.background in BACKGROUNDS ? box.dataset.background : "black";
        this.isStale = true; // what is shown is not what the camera sees
        this.isOverlayStale = true;
        this.movedAt = 0;
        this.lastFrame = 0;
        this.isBusy = false; // with a picture, or a part of one
        this.isOrderWhole = false;
        this.added = null; // Gaussians of the picture of a resting camera so far
        this.view = -1;
        this.path = new CameraPath();
        this.overlay = new Overlay(box.querySelector(".overlay"));
        this.photograph = new Photograph(box, this.place);
        this.picks = new Map(); // what is to be done with points that are asked for
        box.addEventListener("scene", ({ detail }) => this.renew(detail));
        if (box.dataset.scene) this.startOrAsk();
        else this.say("The scene appears here as soon as the poses of the photographs are known.");
    }

    fail(error) {
        this.veil.hidden = false;
        this.veil.querySelector("progress").hidden = true;
        this.say(error.message);
        this.box.dataset.ready = "failed";
    }

    async start() {
        const { scene: asked } = this.box.dataset;
        this.say("Loading the scene");
        this.isLoading = true;
        try {
            this.splats ??= new SplatRenderer(this.canvas); // another scene may have failed before
        } catch {
            this.fail(new Error("This browser has no WebGL 2, so the scene cannot be shown here; the downloads open elsewhere."));
            return;
        }
        try {
            const cameras = await this.loadCameras();
            const scene = await this.load(cameras.views);
            await this.splats.setScene(scene, this.q);
            this.setUp(scene, cameras);
        } catch (error) {
            this.fail(error);
        }
        this.endLoading(asked);
    }

    load(views) {
        const bar = this.veil.querySelector("progress");
        bar.hidden = false;
        const worker = new Worker(new URL("./scene_worker.js", import.meta.url), { type: "module" });
        worker.addEventListener("message", ({ data }) => this.hear(data));
        return new Promise((resolve, reject) => {
            const give = (error) => {
                worker.terminate(); // and what it has loaded so far
                reject(error);
            };
            worker.onerror = () => give(new Error("The scene cannot be loaded."));
            worker.onmessage = ({ data }) => {
                if (data.scene) {
                    this.worker?.terminate();
                    this.worker = worker;
                    worker.onerror = null;
                    this.picks.forEach((found) => found(null)); // which nobody answers any more
                    this.picks.clear();
                    resolve(data.scene);
                } else if (data.error) give(new Error(data.error));
                else if (data.total) {
                    bar.max = data.total;
                    bar.value = data.loaded;
                    this.say(`Loading the scene: ${(data.loaded / 1e6).toFixed(1)} of ${(data.total / 1e6).toFixed(1)} MB`);
                }
            };
            worker.postMessage({ load: new URL(this.box.dataset.scene, location.href).href, views });
        });
    }

    /** What the worker answers besides orders. */
    hear({ picked, id, edited }) {
        if (picked !== undefined) {
            this.picks.get(id)?.(picked);
            this.picks.delete(id);
        }
        if (!edited) return;
        this.box.dispatchEvent(new CustomEvent("edited", { detail: edited }));
        this.sorting.forget();
        this.wake();
    }

    /** The point of the scene at a place of the canvas, px; null where there is none. */
    pick(x, y) {
        const { camera } = this, id = Math.random();
        camera.updateMatrixWorld();
        const far = new Vector3((2 * x) / this.canvas.clientWidth - 1, 1 - (2 * y) / this.canvas.clientHeight, 0.5).unproject(camera);
        const direction = far.sub(camera.position).normalize().toArray();
        this.worker.postMessage({ pick: { origin: camera.position.toArray(), direction, q: this.q }, id });
        return new Promise((resolve) => this.picks.set(id, resolve));
    }

    /** Shows what crop and clean would do; see cleaning.js. */
    edit(wanted, show) {
        this.worker.postMessage({ edit: wanted, show });
    }

    /** Another state of the scene has come: it is shown in the place of the one before, from where the camera is. */
    async renew({ scene, count }) {
        Object.assign(this.box.dataset, { scene, count });
        if (this.isLoading) return; // which looks again in the end
        if (!this.frame) {
            await this.start();
            return;
        }
        this.isLoading = true;
        try {
            const cameras = await this.loadCameras();
            const found = await this.load(cameras.views);
            await this.splats.setScene(found, this.q);
            this.setScene(found, cameras);
        } catch (error) {
            this.place.textContent = error.message; // the state before stays
        }
        this.endLoading(scene);
    }

    endLoading(loaded) {
        this.isLoading = false;
        const { scene, count } = this.box.dataset;
        if (scene !== loaded) this.renew({ scene, count }); // also where the one before could not be shown
    }

    /** The device has taken back its graphics memory, as phones do while another page is looked at. */
    lose() {
        this.isLost = true;
        this.veil.hidden = false;
        this.veil.querySelector("progress").hidden = true;
        this.say("The graphics of this device have stopped; the scene comes back with them.");
    }

    async restore() {
        try {
            await this.splats.setScene(this.scene, this.q);
        } catch (error) {
            this.fail(error);
            return;
        }
        this.isLost = false;
        this.sorting.forget();
        this.wake();
    }

    async loadCameras() {
        for (let left = CAMERA_TRIES; left > 0; left -= 1) {
            try {
                const response = await fetch(this.box.dataset.cameras);
                if (response.ok) return await response.json();
                if (response.status < 500 && response.status !== 429) break;
            } catch { /* the connection may be back soon */ }
            await new Promise((resolve) => setTimeout(resolve, CAMERA_PAUSE_MS));
        }
        return { views: [], isLost: true };
    }

    setUp(scene, cameras) {
        this.frame = cameras.views.length ? cameras : frameOf(scene);
        this.camera = new PerspectiveCamera(50, 1, this.frame.radius * 2e-3, this.frame.radius * 1e4);
        this.camera.up.fromArray(this.frame.up);
        this.controls = new OrbitControls(this.camera, this.canvas);
        Object.assign(this.controls, { enableDamping: true, dampingFactor: 0.12, zoomSpeed: 1.2, minDistance: this.frame.radius * 0.01 });
        this.controls.addEventListener("change", () => this.wake());
        this.controls.addEventListener("start", () => { this.place.textContent = ""; });
        this.walking = new Walking(this.canvas, this.camera, this.controls, this.frame.radius, (action) => this.do(action), () => this.wake());
        const tools = this.box.querySelector(".tools");
        tools.hidden = false;
        tools.addEventListener("click", ({ target }) => target.dataset.do && this.do(target.dataset.do));
        tools.querySelector(".views").addEventListener("change", ({ target }) => target.value && this.do("view", Number(target.value)));
        tools.querySelector("[data-do=full]").hidden = !document.fullscreenEnabled;
        this.splats.setBackground(...BACKGROUNDS[this.background]);
        this.canvas.addEventListener("webglcontextlost", () => this.lose());
        this.canvas.addEventListener("webglcontextrestored", () => this.restore());
        this.takeLight(scene);
        new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
        this.resize();
        this.marks = new Marks(this);
        this.setScene(scene, cameras);
        this.do("reset");
        this.place.textContent = cameras.isLost ? "The places of the photographs could not be loaded." : "";
        this.followLink();
        addEventListener("hashchange", () => this.followLink());
        const panel = document.getElementById("edit");
        if (panel) this.panel = new EditPanel(panel, this);
        requestAnimationFrame((now) => this.tick(now));
    }

    /** What depends on the scene and its cameras, at first and whenever another one has come. */
    setScene(scene, cameras) {
        if (cameras.views.length) this.frame = cameras;
        this.limits = new Limits(this.frame);
        this.pacing = new Pacing(scene.count);
        this.sorting = new Sorting(this.worker, scene.count, this.q, (order, count, limit) => {
            this.splats.setOrder(order, count);
            this.isOrderWhole = limit === Infinity && !this.sorting.wanted;
            this.isStale = true;
            this.added = null;
            Object.assign(this.box.dataset, { ready: "yes", drawn: "part" });
            this.veil.hidden = !this.isLost;
        });
        this.scene = scene;
        this.box.querySelector(".count").textContent = this.box.dataset.count || `${thousands(scene.count)} Gaussians`;
        this.box.querySelectorAll(".with-views").forEach((part) => { part.hidden = !this.frame.views.length || (part.matches(".with-photographs") && !this.box.dataset.photographs); });
        this.listViews();
        if (this.overlay.frusta) this.overlay.showFrusta(this.frame.views, this.frame.radius);
        this.wake();
    }

    listViews() {
        const option = (text, value) => Object.assign(document.createElement("option"), { textContent: text, value });
        const options = this.frame.views.map((view, k) => option(`${view.name}${view.held_out ? " (held out)" : ""}`, k));
        const chosen = this.box.querySelector(".views").value;
        this.box.querySelector(".views").replaceChildren(option(`${this.frame.views.length} photographs`, ""), ...options);
        this.box.querySelector(".views").value = chosen;
        const unplaced = this.frame.unplaced ?? [], list = this.box.querySelector(".unplaced");
        list.hidden = !unplaced.length;
        list.querySelector("summary").textContent = unplaced.length === 1 ? "1 photograph was not placed" : `${unplaced.length} photographs were not placed`;
        list.querySelector("ul").replaceChildren(...unplaced.map((name) => Object.assign(document.createElement("li"), { textContent: name })));
    }

    /** Goes to the view that the address names. */
    followLink() {
        const view = viewOf(location.hash);
        if (view) this.goTo(view.position, new Vector3().fromArray(view.target), view.fovY, view.aspect);
    }

    async copyLink() {
        const hash = linkOf(this.camera.position.toArray(), this.controls.target.toArray(), this.fovY, this.aspect);
        history.replaceState(null, "", hash);
        try {
            await navigator.clipboard.writeText(location.href);
            this.place.textContent = "The link to this view is copied.";
        } catch {
            this.place.textContent = "The link to this view is in the address bar.";
        }
    }

    goTo(position, target, fovY = this.fovY, aspect = this.aspect) {
        this.do("orbit");
        this.view = -1;
        this.lookFrom(position, target, fovY, aspect);
        this.photograph.leave();
        this.wake();
    }

    /**
     * Where materials can be lit here, whoever has a map says so: {map, degrees, lit}, or a map of null for none.
     * The light that was learnt with them is there from the beginning.
     */
    takeLight(scene) {
        if (!this.splats.lighting) return;
        this.box.addEventListener("light", ({ detail: { map, degrees, lit } }) => this.setLight(map, degrees, lit));
        this.box.dataset.materials = "yes";
        this.box.dispatchEvent(new Event("materials"));
        if (!this.box.dataset.light || !scene.knowsMaterials) return;
        this.box.querySelector("[data-do=materials]").hidden = false;
        this.showLearnt();
    }

    /** `lit` is "learnt", "other" or "none". */
    setLight(map, degrees, lit = map ? "other" : "none") {
        if (map !== undefined) {
            this.splats.setLight(map);
            this.box.dataset.lit = lit;
            this.box.querySelector("[data-do=materials]").setAttribute("aria-pressed", String(lit === "learnt"));
            this.box.dispatchEvent(new Event("lit"));
        }
        this.splats.lighting.turn(JSON.parse(this.box.dataset.up), degrees);
        this.wake();
    }

    /** Shows the materials in the light that was learnt with them. */
    async showLearnt() {
        const before = this.box.dataset.lit;
        try {
            if (!this.learnt) {
                const response = await fetch(this.box.dataset.light);
                if (!response.ok) throw new Error();
                this.learnt = readHdr(await response.arrayBuffer());
            }
            if (this.box.dataset.lit === before) this.setLight(this.learnt, 0, "learnt"); // nobody has chosen another since
        } catch {
            this.place.textContent = "The light that was learnt could not be loaded, so materials are not shown.";
        }
    }

    do(action, number) {
        if (action === "orbit" || action === "fly") {
            this.walking.setFlying(action === "fly");
            this.box.querySelectorAll("[data-do=orbit], [data-do=fly]").forEach((button) => button.setAttribute("aria-pressed", String(button.dataset.do === action)));
        } else if (action === "toggle-fly") this.do(this.walking.flying ? "orbit" : "fly");
        else if (action === "next" || action === "previous") this.stepView(action === "next" ? 1 : -1);
        else if (action === "view") this.showView(number);
        else if (action === "measure" || action === "note") this.marks.toggle(action);
        else if (action === "link") this.copyLink();
        else if (action === "cameras") {
            this.overlay.showFrusta(this.overlay.frusta ? null : this.frame.views, this.frame.radius);
            this.box.querySelector("[data-do=cameras]").setAttribute("aria-pressed", String(this.overlay.frusta !== null));
        } else if (action === "background") {
            this.background = this.background === "black" ? "white" : "black";
            this.splats.setBackground(...BACKGROUNDS[this.background]);
        } else if (action === "materials") {
            if (!this.splats.lighting || !this.box.dataset.light || this.box.querySelector("[data-do=materials]").hidden) return;
            if (this.box.dataset.lit === "learnt") this.setLight(null, 0);
            else this.showLearnt();
        } else if (action === "key") this.tellPath(this.path.add(this.camera));
        else if (action === "save-path") this.path.save("camera_path.json");
        else if (action === "clear-path") {
            this.path.clear();
            this.tellPath(0);
        } else if (action === "full") {
            if (document.fullscreenElement) document.exitFullscreen();
            else this.box.requestFullscreen();
        } else if (action === "reset") {
            const held = this.frame.views.findIndex((view) => view.held_out);
            if (this.frame.views.length) this.showView(Math.max(0, held));
            else this.lookFrom(this.frame.start, new Vector3().fromArray(this.frame.target), 50, 1);
            this.do("orbit");
            this.place.textContent = "";
        }
        this.wake();
    }

    /** Shows how many cameras the path has. */
    tellPath(count) {
        this.box.querySelector("[data-do=save-path]").textContent = `Save path (${count})`;
        this.box.querySelectorAll("[data-do=save-path], [data-do=clear-path]").forEach((button) => { button.hidden = count === 0; });
        if (count) this.place.textContent = `Camera ${count} of the path`;
    }

    stepView(step) {
        const count = this.frame.views.length;
        if (count) this.showView(this.view < 0 ? (step > 0 ? 0 : count - 1) : (this.view + step + count) % count);
    }

    showView(index) {
        const view = this.frame.views[index];
        this.view = index;
        const position = new Vector3().fromArray(view.position), forward = new Vector3().fromArray(view.forward);
        // Turn about what the photograph looks at: the scene's middle, as far along the view as that is.
        const depth = new Vector3().fromArray(this.frame.target).sub(position).dot(forward);
        const distance = Math.max(depth, 0.1 * this.frame.radius);
        this.lookFrom(view.position, position.clone().addScaledVector(forward, distance), view.fov_y_degrees, view.aspect);
        this.place.textContent = `${view.name}${view.held_out ? " (held out)" : ""}`;
        this.box.querySelector(".views").value = String(index);
        this.overlay.chosen = index;
        this.photograph.goTo(view);
        this.leavesAt = { position: this.camera.position.clone(), quaternion: this.camera.quaternion.clone() };
    }

    lookFrom(position, target, fovY, aspect) {
        this.camera.position.fromArray(position);
        this.controls.target.copy(target);
        this.fovY = Math.min(100, fovY);
        this.aspect = aspect;
        this.controls.update();
        this.resize();
    }

    resize() {
        const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
        if (!width || !height) return;
        this.splats.setSize(width, height, Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
        this.camera.aspect = width / height;
        // The whole photograph fits into the window.
        const fits = Math.max(1, (this.aspect ?? 1) / this.camera.aspect);
        this.camera.fov = (360 / Math.PI) * Math.atan(Math.tan(((this.fovY ?? 50) * Math.PI) / 360) * fits);
        this.camera.updateProjectionMatrix();
        this.overlay.setSize(width, height, Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
        this.photograph.fit(this.camera);
        this.wake();
    }

    wake() {
        this.isStale = this.isOverlayStale = true;
        this.added = null;
        this.movedAt = performance.now();
        Object.assign(this.box.dataset, { rested: "no", drawn: "part" });
    }

    /** Moves the camera and draws; nothing is asked for while the picture before is not there. */
    tick(now) {
        requestAnimationFrame((next) => this.tick(next));
        const seconds = Math.min(0.1, (now - this.lastFrame) / 1000);
        this.lastFrame = now;
        if (this.walking.step(seconds)) this.wake();
        if (!this.walking.flying) this.controls.update();
        this.limits.clampTarget(this.controls.target);
        if (this.limits.clamp(this.camera.position) && !this.walking.flying) this.camera.lookAt(this.controls.target);
        // Once for each change: a page that changes in every frame leaves a software renderer no time for the scene.
        if (this.isOverlayStale) this.drawOverlay();
        if (this.isBusy || this.isLost || !this.isStale) return;
        this.camera.updateMatrixWorld();
        if (performance.now() - this.movedAt < REST_MS) this.drawMoving();
        else this.drawResting();
    }

    drawOverlay() {
        const at = this.leavesAt;
        if (at && (at.position.distanceTo(this.camera.position) > 1e-3 * this.frame.radius || at.quaternion.angleTo(this.camera.quaternion) > 1e-3)) {
            this.leavesAt = null;
            this.overlay.chosen = -1;
            this.photograph.leave();
            this.box.querySelector(".views").value = ""; // so that it can be chosen again
        }
        this.overlay.draw(this.camera);
        this.isOverlayStale = false;
    }

    /** Draws the heaviest Gaussians with fewer pixels, as many as there is time for. */
    drawMoving() {
        const limit = this.pacing.limit < this.pacing.count ? this.pacing.limit : Infinity;
        this.sort(limit);
        if (!this.splats.ordered || this.splats.ordered > limit) return; // the order of a resting camera is too much to wait for
        this.splats.scale = this.pacing.scale;
        this.splats.render(this.camera);
        this.isStale = false;
        this.wait((milliseconds) => {
            this.pacing.noteFrame(milliseconds);
            this.box.dataset.frameMs = milliseconds.toFixed(1);
            this.isStale = true; // until the camera rests and all is drawn
        });
    }

    /** Draws all Gaussians, part by part, and shows them together: first with as few pixels as while moving, then with all. */
    drawResting() {
        this.sort(Infinity);
        if (!this.isOrderWhole) return;
        if (this.added === null) {
            this.added = 0;
            this.splats.scale = this.box.dataset.drawn === "all" ? 1 : this.pacing.scale;
            this.splats.begin();
        }
        const count = Math.min(this.pacing.slice, this.splats.ordered - this.added);
        this.splats.add(this.camera, this.added, count);
        this.added += count;
        if (this.added >= this.splats.ordered) {
            this.splats.show(this.camera);
            this.box.dataset.drawn = "all";
            if (this.splats.scale < 1) this.added = null; // sharper next, which may take a slow device long
            else {
                this.isStale = false;
                this.box.dataset.rested = "yes";
            }
        }
        this.wait((milliseconds) => { if (count === this.pacing.slice) this.pacing.noteSlice(milliseconds); });
    }

    sort(limit) {
        if (this.sorting.see(this.camera, this.camera.position.distanceTo(this.controls.target), limit)) this.isOrderWhole = false;
    }

    /** Calls back with how long what was asked for takes. */
    async wait(note) {
        this.isBusy = true;
        const begun = performance.now();
        await this.splats.finished();
        note(performance.now() - begun);
        this.isBusy = false;
    }
}

/** Where to look from when the cameras are not known: COLMAP's y is down. */
function frameOf({ count, geometry }) {
    const axis = (k) => Float32Array.from({ length: count }, (_, i) => geometry[12 * i + k]).sort();
    const sorted = [axis(0), axis(1), axis(2)];
    const at = (share) => sorted.map((values) => values[Math.min(count - 1, Math.floor(share * count))]);
    const target = at(0.5), low = at(0.1), high = at(0.9);
    const radius = Math.hypot(...high.map((value, k) => value - low[k])) || 1;
    return { up: [0, -1, 0], target, radius, views: [], start: [target[0], target[1] - 0.3 * radius, target[2] - 1.4 * radius] };
}

const box = document.getElementById("viewer");
if (box) new Viewer(box);
