// The photograph of the view that the camera is at: over the scene, as far as it covers it, or beside it in a corner.

import { Vector3 } from "../vendor/three.js";

export class Photograph {
    constructor(box, place) {
        this.image = box.querySelector(".photo");
        this.mode = box.querySelector(".photo-mode");
        this.share = box.querySelector(".photo-share");
        this.address = box.dataset.photographs;
        this.view = null;
        this.isAtView = false;
        this.isThere = false; // the image that the element names has come
        box.querySelectorAll(".with-photographs").forEach((part) => { part.hidden ||= !this.address; });
        this.mode.addEventListener("change", () => this.show());
        this.share.addEventListener("input", () => { this.image.style.opacity = this.share.value / 100; });
        this.image.addEventListener("load", () => {
            this.isThere = true;
            this.show();
        });
        this.image.addEventListener("error", () => {
            this.isThere = false;
            this.image.hidden = true;
            if (this.mode.value) place.textContent = "This browser cannot show the photograph.";
        });
    }

    /** The camera is at a view as of cameras.json. */
    goTo(view) {
        this.view = view;
        this.isAtView = true;
        this.show();
    }

    /** The camera has left the view, so that the photograph does not cover the scene any more. */
    leave() {
        if (!this.isAtView) return;
        this.isAtView = false;
        this.show();
    }

    show() {
        const mode = this.mode.value, { image, view } = this;
        this.share.hidden = mode !== "over";
        // A panorama lies over no view.
        if (!view || !mode || (mode === "over" && (!this.isAtView || view.panorama))) {
            image.hidden = true;
            return;
        }
        const address = `${this.address}images/${view.name.split("/").map(encodeURIComponent).join("/")}`;
        if (image.getAttribute("src") !== address) {
            this.isThere = false;
            image.src = address;
        }
        image.hidden = !this.isThere; // the one before would be shown until then
        image.alt = `Photograph ${view.name}`;
        image.classList.toggle("corner", mode === "corner");
        image.style.opacity = mode === "over" ? this.share.value / 100 : 1;
        this.fit();
    }

    /** Lays the photograph over what the camera sees of its place. */
    fit(camera = this.camera) {
        this.camera = camera;
        if (!camera || !this.view || this.image.hidden) return;
        const tangent = (degrees) => Math.tan((degrees * Math.PI) / 360);
        const height = this.image.parentElement.clientHeight * (tangent(this.view.fov_y_degrees) / tangent(camera.fov));
        const isOver = this.mode.value === "over";
        Object.assign(this.image.style, { height: isOver ? `${height}px` : "", width: isOver ? `${height * this.view.aspect}px` : "", rotate: isOver ? `${rollOf(this.view, camera)}rad` : "" });
    }
}

/** By how much a photograph is turned clockwise as the viewer's camera sees it, which is always upright. */
function rollOf({ up }, { quaternion }) {
    const top = new Vector3().fromArray(up);
    return Math.atan2(top.dot(new Vector3(1, 0, 0).applyQuaternion(quaternion)), top.dot(new Vector3(0, 1, 0).applyQuaternion(quaternion)));
}
