// Asks before what cannot be undone. A plain script in the head, not a module: modules run after the page is shown, and
// a click that comes before them would delete without a question.

document.addEventListener("click", (event) => {
    const asks = event.target.closest?.("[data-confirm]");
    if (!asks || window.confirm(asks.dataset.confirm)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
}, { capture: true });
