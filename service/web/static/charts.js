// Curves of the training on uPlot.

import uPlot from "./vendor/uplot.js";
import { thousands } from "./numbers.js";

const CHARTS = [
    { key: "psnr", title: "PSNR", unit: "dB", digits: 2 },
    { key: "loss", title: "Loss", unit: "", digits: 4, logarithmic: true },
    { key: "gaussians", title: "Gaussians", unit: "", digits: 0 },
];
const HEIGHT = 170;
const dark = matchMedia("(prefers-color-scheme: dark)");
const short = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

/** The points of a training; one that goes back to a checkpoint takes its later points along. */
export class Training {
    constructor() {
        this.iterations = [];
        this.values = Object.fromEntries(CHARTS.map(({ key }) => [key, []]));
    }

    add(event) {
        if (typeof event.iteration !== "number" || typeof event.loss !== "number") return false;
        while (this.iterations.length && this.iterations.at(-1) >= event.iteration) {
            this.iterations.pop();
            CHARTS.forEach(({ key }) => this.values[key].pop());
        }
        this.iterations.push(event.iteration);
        CHARTS.forEach(({ key }) => this.values[key].push(event[key] ?? null));
        return true;
    }
}

/** Draws a training into a box and keeps it as wide as that. */
export class Charts {
    constructor(box, training) {
        this.box = box;
        this.training = training;
        this.plots = [];
        new ResizeObserver(() => this.resize()).observe(box);
        dark.addEventListener("change", () => this.build());
    }

    update() {
        if (this.training.iterations.length < 2) return;
        if (!this.plots.length) this.build();
        this.plots.forEach(({ plot, chart, output }) => {
            plot.setData([this.training.iterations, this.training.values[chart.key]]);
            this.say(output, chart, null);
        });
    }

    build() {
        if (this.training.iterations.length < 2) return;
        const style = getComputedStyle(document.documentElement);
        const colour = (name) => style.getPropertyValue(name).trim();
        this.plots.forEach(({ plot }) => plot.destroy());
        this.box.replaceChildren();
        this.plots = CHARTS.map((chart) => {
            const card = document.createElement("div"), title = document.createElement("h3"), output = document.createElement("output");
            card.className = "card chart";
            title.append(chart.unit ? `${chart.title}, ${chart.unit}` : chart.title, output);
            card.append(title);
            this.box.append(card);
            const axis = { stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
            const plot = new uPlot({
                width: Math.max(120, card.clientWidth - 20), height: HEIGHT,
                legend: { show: false },
                cursor: { y: false, drag: { x: true, y: false } },
                scales: { x: { time: false }, y: chart.logarithmic ? { distr: 3 } : {} },
                axes: [
                    { ...axis, size: 26, values: (_, ticks) => ticks.map((tick) => short.format(tick)) },
                    { ...axis, size: 44, values: (_, ticks) => ticks.map((tick) => tick === null ? "" : chart.logarithmic ? String(Number(tick.toPrecision(1))) : short.format(tick)) },
                ],
                series: [{}, { stroke: colour("--accent"), width: 1.8, points: { show: false } }],
                hooks: { setCursor: [(self) => this.say(output, chart, self.cursor.idx)] },
            }, [this.training.iterations, this.training.values[chart.key]], card);
            plot.root.setAttribute("role", "img");
            plot.root.setAttribute("aria-label", `${chart.title} over the iterations`);
            this.say(output, chart, null);
            return { plot, chart, output, card };
        });
    }

    say(output, chart, index) {
        const at = index ?? this.training.iterations.length - 1;
        const value = this.training.values[chart.key][at];
        output.textContent = value == null ? "" : `${thousands(value, chart.digits)} at ${thousands(this.training.iterations[at])}`;
    }

    resize() {
        this.plots.forEach(({ plot, card }) => plot.setSize({ width: Math.max(120, card.clientWidth - 20), height: HEIGHT }));
    }
}
