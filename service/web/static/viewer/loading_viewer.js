// What the viewers share: loading begins by itself where it is little, and else when it is asked for.

const AUTOMATIC_BYTES = 80e6;

export class LoadingViewer {
    constructor(box) {
        this.box = box;
        this.canvas = box.querySelector("canvas");
        this.veil = box.querySelector(".veil");
    }

    startOrAsk() {
        const button = this.veil.querySelector("button");
        if (Number(this.box.dataset.size) <= AUTOMATIC_BYTES && !navigator.connection?.saveData) this.start();
        else {
            this.say("");
            button.hidden = false;
            button.addEventListener("click", () => { button.hidden = true; this.start(); });
        }
    }

    say(text) {
        this.veil.querySelector(".veil-text").textContent = text;
    }
}
