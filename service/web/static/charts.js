// Curves of the training on uPlot.

import uPlot from "./vendor/uplot.js";
import { thousands } from "./numbers.js";

// The first of several curves of a chart is the one that is read out.
const CHARTS = [
    { title: "PSNR", unit: "dB", digits: 2, curves: [{ key: "held_out_psnr", label: "held-out views", color: "--accent" }, { key: "training_psnr", label: "training rays", color: "--soft", dash: [4, 3] }] },
    { title: "Loss", unit: "", digits: 4, logarithmic: true, curves: [{ key: "loss", label: "loss", color: "--accent" }] },
    { title: "Gaussians", unit: "", digits: 0, curves: [{ key: "gaussians", label: "Gaussians", color: "--accent" }] },
];
const KEYS = CHARTS.flatMap(({ curves }) => curves.map(({ key }) => key));
const HEIGHT = 170;
const dark = matchMedia("(prefers-color-scheme: dark)");
const short = new Intl.NumberFormat("en", { notation: "compact", maximumFractionDigits: 1 });

/** The points of a training; one that goes back to a checkpoint takes its later points along. */
export class Training {
    constructor() {
        this.iterations = [];
        this.values = Object.fromEntries(KEYS.map((key) => [key, []]));
    }

    add(event) {
        if (typeof event.iteration !== "number" || typeof event.loss !== "number") return false;
        // Records of earlier versions call the training's figure psnr.
        const { loss, gaussians, training_psnr = event.psnr } = event;
        this.put(event.iteration, { loss, gaussians, training_psnr });
        return true;
    }

    addHeldOut({ iteration, psnr }) {
        if (typeof iteration !== "number" || typeof psnr !== "number") return false;
        this.put(iteration, { held_out_psnr: psnr });
        return true;
    }

    put(iteration, values) {
        while (this.iterations.length && this.iterations.at(-1) > iteration) {
            this.iterations.pop();
            KEYS.forEach((key) => this.values[key].pop());
        }
        if (this.iterations.at(-1) !== iteration) {
            this.iterations.push(iteration);
            KEYS.forEach((key) => this.values[key].push(null));
        }
        for (const [key, value] of Object.entries(values)) this.values[key][this.iterations.length - 1] = value ?? null;
    }

    data({ curves }) {
        return [this.iterations, ...curves.map(({ key }) => this.values[key])];
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
            plot.setData(this.training.data(chart));
            this.say(output, chart, null);
        });
    }

    build() {
        if (this.training.iterations.length < 2) return;
        const style = getComputedStyle(document.documentElement);
        const color = (name) => style.getPropertyValue(name).trim();
        this.plots.forEach(({ plot }) => plot.destroy());
        this.box.replaceChildren();
        this.plots = CHARTS.map((chart) => {
            const card = document.createElement("div"), title = document.createElement("h3"), output = document.createElement("output");
            card.className = "card chart";
            title.append(Object.assign(document.createElement("span"), { textContent: chart.unit ? `${chart.title}, ${chart.unit}` : chart.title }), output);
            card.append(title);
            this.box.append(card);
            const axis = { stroke: color("--soft"), grid: { stroke: color("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
            const plot = new uPlot({
                width: Math.max(120, card.clientWidth - 20), height: HEIGHT,
                legend: { show: false },
                cursor: { y: false, drag: { x: true, y: false } },
                scales: { x: { time: false }, y: chart.logarithmic ? { distr: 3 } : {} },
                axes: [
                    { ...axis, size: 26, values: (_, ticks) => ticks.map((tick) => short.format(tick)) },
                    { ...axis, size: 44, values: (_, ticks) => ticks.map((tick) => tick === null ? "" : chart.logarithmic ? String(Number(tick.toPrecision(1))) : short.format(tick)) },
                ],
                series: [{}, ...chart.curves.map((curve) => ({ label: curve.label, stroke: color(curve.color), width: 1.8, dash: curve.dash, spanGaps: true, points: { show: false } }))],
                hooks: { setCursor: [(self) => this.say(output, chart, self.cursor.idx)] },
            }, this.training.data(chart), card);
            plot.root.setAttribute("role", "img");
            const labels = chart.curves.length > 1 ? ` of ${chart.curves.map(({ label }) => label).join(" and ")}` : "";
            plot.root.setAttribute("aria-label", `${chart.title}${labels} over the iterations`);
            this.say(output, chart, null);
            return { plot, chart, output, card };
        });
    }

    /** Writes the values at a point, or the newest ones, beside the title; with several curves, under their names. */
    say(output, chart, index) {
        const last = this.training.iterations.length - 1;
        const parts = chart.curves.map(({ key, label, color, dash }) => {
            const values = this.training.values[key];
            let at = index ?? last;
            while (at >= 0 && values[at] == null) at -= 1; // not every point has every value
            if (at < 0) return null;
            const part = document.createElement("span");
            if (chart.curves.length > 1) {
                const line = Object.assign(document.createElement("i"), { className: dash ? "curve dashed" : "curve" });
                line.style.color = `var(${color})`;
                part.append(line, `${label} `);
            }
            part.append(`${thousands(values[at], chart.digits)} at ${thousands(this.training.iterations[at])}`);
            return part;
        });
        output.replaceChildren(...parts.filter((part) => part !== null));
    }

    resize() {
        this.plots.forEach(({ plot, card }) => plot.setSize({ width: Math.max(120, card.clientWidth - 20), height: HEIGHT }));
    }
}
