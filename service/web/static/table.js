// Tables that sort by a column, and show the view of the row that is chosen.

function sortBy(table, heading, direction) {
    const headings = [...table.tHead.rows[0].cells];
    const column = headings.indexOf(heading);
    const value = (row) => row.cells[column].dataset.sort;
    const numeric = column > 0;
    const sign = direction === "ascending" ? 1 : -1;
    const rows = [...table.tBodies[0].rows].sort((a, b) => {
        const [x, y] = [value(a), value(b)];
        if (x === "" || y === "") return (x === "") - (y === ""); // what is not known comes last
        return sign * (numeric ? Number(x) - Number(y) : x.localeCompare(y, undefined, { numeric: true }));
    });
    headings.forEach((other) => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", direction);
    table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll("table.sortable")) {
    for (const heading of table.tHead.rows[0].cells) {
        heading.querySelector("button").addEventListener("click", () => {
            const now = heading.getAttribute("aria-sort");
            const first = heading.dataset.first ?? "ascending";
            sortBy(table, heading, now === null ? first : now === "ascending" ? "descending" : "ascending");
        });
    }
}

const shown = document.getElementById("view-shown");
const rows = [...document.querySelectorAll("tr[data-render]")];
let mode = "render";

/** The picture that is meant: the render of the view that is chosen, or what lies behind it. */
function show() {
    const row = rows.find((other) => other.classList.contains("current") && other.dataset.render) ?? rows[0];
    const button = shown.querySelector(`[data-mode=${mode}][data-layer]`);
    const label = button?.dataset.layer ?? "Render", name = row.cells[0].dataset.sort;
    const below = shown.querySelector(".below"), tag = shown.querySelector(".tag.right");
    below.src = button ? row.dataset.render.replace("/renders/", `/layers/${mode}/`) : row.dataset.render;
    below.alt = `${label} of ${name}`;
    if (tag) tag.textContent = label;
    shown.querySelector(".compare").classList.toggle("difference", mode === "difference");
}
for (const row of shown ? rows : []) {
    row.addEventListener("click", () => {
        rows.forEach((other) => other.classList.toggle("current", other === row));
        const name = row.cells[0].dataset.sort;
        const below = shown.querySelector(".below"), above = shown.querySelector(".above");
        below.width = row.dataset.width;
        below.height = row.dataset.height;
        show();
        if (above) {
            above.src = row.dataset.photograph ?? "";
            above.alt = `Photograph ${name}`;
        }
        shown.querySelector(".view-name").textContent = name;
    });
}
for (const button of shown?.querySelectorAll("[data-mode]") ?? []) {
    button.addEventListener("click", () => {
        shown.querySelectorAll("[data-mode]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
        mode = button.dataset.mode;
        show();
    });
}
