// What every page does: notices, quiet polling, and fields that are wrong are shown.

export function notify(text, bad = false) {
    const notice = document.createElement("p");
    notice.className = bad ? "notice bad" : "notice";
    notice.textContent = text;
    document.getElementById("notices").append(notice);
    setTimeout(() => notice.remove(), bad ? 9000 : 5000);
}

document.addEventListener("notice", ({ detail }) => notify(detail.text, detail.bad));

// A page that nobody looks at asks for nothing, nor does a list in which something is ticked: it would be unticked.
document.addEventListener("htmx:config:request", (event) => {
    const isTicked = document.querySelector(".tick:checked") !== null;
    if ((document.hidden || isTicked) && event.target.matches("[data-poll]")) event.preventDefault();
});

let lost = null;
document.addEventListener("htmx:error", () => {
    if (lost) return;
    lost = document.createElement("p");
    lost.className = "notice bad";
    lost.textContent = "The service does not answer; trying again.";
    document.getElementById("notices").append(lost);
});
document.addEventListener("htmx:after:swap", () => {
    lost?.remove();
    lost = null;
});

// A browser sends no form with a wrong field, and says so only beside the field: folds above it are opened for that.
document.addEventListener("invalid", ({ target }) => {
    for (let fold = target.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
}, { capture: true });

// A link to a view has it behind #, which no server hears of: a sign-in on the way hands it on.
const next = document.querySelector(".sign-in [name=next]");
if (next && location.hash) next.value += location.hash;
