// Two pictures and a divider: a range input over them moves the cut, by pointer, touch and keys.

export function enliven(box) {
    box.querySelector("input")?.addEventListener("input", ({ target }) => box.style.setProperty("--cut", `${target.value}%`));
    // As large as the page allows, and never higher than the window.
    const below = box.querySelector(".below");
    const fit = () => { if (below.naturalHeight) box.style.setProperty("--ratio", String(below.naturalWidth / below.naturalHeight)); };
    below.addEventListener("load", fit);
    fit();
    // A photograph that is gone, or that this browser cannot show, leaves the render alone.
    const above = box.querySelector(".above");
    above?.addEventListener("error", () => box.querySelectorAll(".above, .tag, .divider, input").forEach((part) => { part.hidden = true; }));
    above?.addEventListener("load", () => box.querySelectorAll(".above, .tag, .divider, input").forEach((part) => { part.hidden = false; }));
}

/** Makes one anew, with the same parts as the template's. */
export function comparison(below, belowLabel, above, aboveLabel, name) {
    const box = document.createElement("div");
    box.className = "compare";
    const picture = (className, src, alt) => Object.assign(new Image(), { className, src, alt, decoding: "async" });
    const span = (className, text = "") => Object.assign(document.createElement("span"), { className, textContent: text });
    box.append(picture("below", below, `${belowLabel} of ${name}`));
    if (above) {
        const range = Object.assign(document.createElement("input"), { type: "range", min: 0, max: 100, step: 0.5, value: 50 });
        range.setAttribute("aria-label", `Divider between ${aboveLabel.toLowerCase()} and ${belowLabel.toLowerCase()} of ${name}`);
        box.append(picture("above", above, `${aboveLabel} ${name}`), span("tag left", aboveLabel), span("tag right", belowLabel), span("divider"), range);
    }
    enliven(box);
    return box;
}

document.querySelectorAll("[data-compare]").forEach(enliven);
