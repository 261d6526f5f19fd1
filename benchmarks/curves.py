"""PSNR over the time of the training, of several runs in one picture.

    python -m benchmarks.curves RUN[=LABEL] ... -o curves.png [--cpu-seconds S ...]

    python -m benchmarks.curves old/fox=fox:before new/fox=fox:now old/room=room:before new/room=room:now \\
        -o curves.png --cpu-seconds 747 706 2751 2700

A run is a folder that ``octasplat reconstruct`` made, with this or an earlier version. Labels with a colon
name a panel first; each has its own axes. Full lines are the held-out views' probe, dashed ones the running
PSNR of the training rays. Dots are means over whole views at the end: full ones held out, open ones trained
on, where the run has noted that.

Seconds depend on what else the machine did. Where the CPU seconds of the commands are known (by
``/usr/bin/time -f '%U %S'``, summed), ``--cpu-seconds`` takes one number a run and stretches its time to
them, as if every second of the command had cost the same; of times when nothing happened, because the machine
was suspended, nothing is left. The first fiftieth of the time is not shown.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.events import read_events
from octasplat.engine.evaluate.curves import Row, training_values
from octasplat.engine.evaluate.held_out import METRICS
from octasplat.engine.runs.run_folder import EVENTS, TRAINING

Values = list[tuple[float, float]]
HEIGHT_IN, WIDTH_IN, DOTS_AN_INCH = 4.6, 6.4, 130
SHOWN_FROM = 1 / 50
"""Share of the longest run at which the axis begins."""
STALL = 30.0
"""Times the median step between two events, beyond which nothing happened."""


@dataclass(frozen=True)
class RunCurves:
    """What is drawn of a run.

    Attributes:
        panel: Where, may be empty.
        label: Its name there.
        held_out: Seconds and dB of the held-out views' probe.
        trained: The same of the training rays.
        held_out_end: Mean of whole held-out views at the end, dB; None where the run has not noted it.
        trained_end: The same of the training views.
    """

    panel: str
    label: str
    held_out: Values
    trained: Values
    held_out_end: float | None
    trained_end: float | None


def read_run(folder: Path, label: str = "", cpu_seconds: float | None = None) -> RunCurves:
    """The curves of a run.

    Args:
        folder: Of the run.
        label: ``PANEL:NAME`` or ``NAME``; by default the folder's name.
        cpu_seconds: That the whole command took; None leaves the seconds as they are.

    Raises:
        ValueError: The folder holds no events of a training.
    """
    events = read_events(folder / EVENTS)
    curves = [training_values(events, kind, "psnr") for kind in ("held_out_measured", "training_progress")]
    if not any(curves):
        raise ValueError(f"{folder / EVENTS} tells of no training; name the folder of a run.")
    if cpu_seconds is not None:
        curves = _stretched(events, curves, cpu_seconds)
    panel, _, name = (label or folder.name).rpartition(":")
    held_out_end = _noted(folder / METRICS, "mean")
    return RunCurves(panel, name, *curves, held_out_end, _noted(folder / TRAINING, "training_views"))


def _stretched(events: Sequence[Row], curves: list[Values], cpu_seconds: float) -> list[Values]:
    """Curves whose seconds are CPU seconds, as far as these can be told."""
    at = np.unique([x for values in curves for x, _ in values])
    steps = np.diff(at)
    busy = np.minimum(steps, STALL * np.median(steps))
    times = [float(time) for row in events if isinstance(time := row.get("time"), int | float)]
    stretch = cpu_seconds / (times[-1] - times[0] - (steps - busy).sum())
    moved = dict(zip(at.tolist(), (stretch * (at[0] + np.append(0.0, busy.cumsum()))).tolist(), strict=True))
    return [[(moved[x], y) for x, y in values] for values in curves]


def _noted(path: Path, group: str) -> float | None:
    """The PSNR in a group of a JSON file of a run."""
    if not path.exists():
        return None
    found = json.loads(path.read_text(encoding="utf-8")).get(group) or {}
    return found.get("psnr")


def draw(runs: Sequence[RunCurves], path: Path, x_label: str) -> None:
    """Draw the runs into a picture."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    panels = list(dict.fromkeys(run.panel for run in runs))
    size = (WIDTH_IN * len(panels), HEIGHT_IN)
    figure, axes = pyplot.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
    for panel, plot in zip(panels, axes[0], strict=True):
        here = [run for run in runs if run.panel == panel]
        since = SHOWN_FROM * max(x for run in here for x, _ in run.held_out + run.trained)
        for k, run in enumerate(here):
            _draw_run(plot, run, f"C{k}", since)
        plot.set_xscale("log")
        plot.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        plot.xaxis.set_major_formatter(ScalarFormatter())
        plot.xaxis.set_minor_formatter(NullFormatter())
        plot.set_title(panel)
        plot.set_xlabel(x_label)
        plot.set_ylabel("PSNR, dB")
        plot.grid(alpha=0.3, which="both")
        plot.legend(loc="lower right")
    figure.savefig(path, dpi=DOTS_AN_INCH)
    pyplot.close(figure)


def _draw_run(plot, run: RunCurves, color: str, since: float) -> None:
    lines = (
        (run.held_out, run.held_out_end, "-", color, "held out"),
        (run.trained, run.trained_end, "--", "none", "training rays"),
    )
    for values, end, style, fill, what in lines:
        shown = [(x, y) for x, y in values if x >= since]
        if not shown:
            continue
        plot.plot(*zip(*shown, strict=True), style, color=color, label=f"{run.label}, {what}", lw=1.4)
        if end is not None:
            plot.plot(shown[-1][0], end, "o", color=color, mfc=fill, ms=6)


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the picture and print the ends of the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN[=LABEL]")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cpu-seconds", type=float, nargs="+", help="of each run's whole command")
    options = parser.parse_args(arguments)
    costs = options.cpu_seconds or [None] * len(options.runs)
    if len(costs) != len(options.runs):
        parser.error(f"--cpu-seconds takes one number for each of the {len(options.runs)} runs")
    named = [text.partition("=") for text in options.runs]
    try:
        runs = [
            read_run(Path(folder), label, cost) for (folder, _, label), cost in zip(named, costs, strict=True)
        ]
    except ValueError as error:
        sys.exit(str(error))
    draw(runs, options.output, "training, CPU seconds" if options.cpu_seconds else "training, seconds")
    for run in runs:
        for what, values, end in (
            ("held out", run.held_out, run.held_out_end),
            ("training rays", run.trained, run.trained_end),
        ):
            if values:
                whole = "" if end is None else f", whole views {end:.2f}"
                name = f"{run.panel} {run.label}".strip()
                print(f"{name}: {what} {values[-1][1]:.2f} dB after {values[-1][0]:.0f} s{whole}")


if __name__ == "__main__":
    main()
