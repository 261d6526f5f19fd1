// What every page does: notices, and quiet polling.

export function notify(text, bad = false) {
    const notice = document.createElement("p");
    notice.className = bad ? "notice bad" : "notice";
    notice.textContent = text;
    document.getElementById("notices").append(notice);
    setTimeout(() => notice.remove(), bad ? 9000 : 5000);
}

document.addEventListener("notice", ({ detail }) => notify(detail.text, detail.bad));

// Before anything else hears of the click: what is asked must not depend on how far the page has been set up.
document.addEventListener("click", (event) => {
    const asks = event.target.closest?.("[data-confirm]");
    if (!asks || window.confirm(asks.dataset.confirm)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
}, { capture: true });

// A page that nobody looks at asks for nothing.
document.addEventListener("htmx:config:request", (event) => {
    if (document.hidden && event.target.matches("[data-poll]")) event.preventDefault();
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
