"""The gallery of ``docs/gallery.md``: generated scenes, reconstructed anew, at the same views each time.

    python -m benchmarks.gallery                               # some fifteen CPU minutes; writes into docs/
    python -m benchmarks.gallery --scenes table street         # these alone
    python -m benchmarks.gallery -o NEW --compare docs         # beside the pictures and figures of docs/

Each scene has the worst held-out view and a median one, as photograph, render and error, and a view half-way
between two training cameras. Which views these are stands in ``images/gallery/gallery.json`` and stays so,
unless ``--choose-views`` is given. Only the marked parts of a page that is there are written.

A gallery that was interrupted goes on where it was. What it keeps for that is removed when all is done,
unless ``--runs`` names a folder for it; there, finished runs are taken as they are.
"""

import argparse
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from benchmarks.gallery_scenes import (
    SCENES,
    SceneFigures,
    ShownView,
    available,
    scene_figures,
    train,
    write_strips,
)
from benchmarks.marked_parts import has_part, marks, with_part
from octasplat.engine.core.threads import use_threads
from octasplat.engine.core.writing import write_json, write_text
from octasplat.engine.settings.preset_names import PRESETS

DOCS = Path(__file__).resolve().parents[1] / "docs"
RUNS = Path("out") / "gallery"
PAGE, PICTURES, FIGURES = "gallery.md", Path("images") / "gallery", "gallery.json"
EARLIER = "earlier"
PROGRAM, TABLE = "benchmarks.gallery", "figures"
STRIPS: Mapping[str, str] = {
    "worst": "Worst held-out view",
    "median": "Median held-out view",
    "between": "Half-way between two training views",
}
START = """# Gallery

Generated scenes as the version of today reconstructs them; `python -m benchmarks.gallery` makes them.

"""


class Gallery(BaseModel):
    """The figures of a gallery, by the names of the scenes; the content of ``gallery.json``."""

    model_config = ConfigDict(frozen=True)

    scenes: dict[str, SceneFigures] = {}


def read_gallery(folder: Path, *, needed: bool = False) -> Gallery:
    """Return the figures of the gallery in a folder; empty if there is none.

    Raises:
        SystemExit: the file is no gallery's, or missing though ``needed``.
    """
    path = folder / PICTURES / FIGURES
    if not path.exists() and not needed:
        return Gallery()
    try:
        return Gallery.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise SystemExit(f"{path} holds no figures of a gallery; name the folder of one.") from error


def copy_earlier(earlier: Path, output: Path, names: Sequence[str]) -> None:
    """Copy the pictures of an earlier gallery beside those of a new one, as far as they are there."""
    (output / PICTURES / EARLIER).mkdir(parents=True, exist_ok=True)
    for name in names:
        for strip in STRIPS:
            picture = earlier / PICTURES / f"{name}_{strip}.jpg"
            if picture.exists():
                shutil.copyfile(picture, output / PICTURES / EARLIER / picture.name)


def write_page(output: Path, gallery: Gallery, earlier: Gallery | None = None) -> None:
    """Write the marked parts of the page, and those that it lacks at its end."""
    path = output / PAGE
    text = path.read_text(encoding="utf-8") if path.exists() else START
    parts = {TABLE: figures_table(gallery, earlier)}
    for name in (known for known in SCENES if known in gallery.scenes):
        before = None if earlier is None else earlier.scenes.get(name)
        parts[name] = scene_part(name, gallery.scenes[name], before)
    for name, part in parts.items():
        if not has_part(text, name, PROGRAM):
            begin, end = marks(name, PROGRAM)
            heading = f"## {SCENES[name].title}\n\n" if name in SCENES else ""
            text = f"{text.rstrip()}\n\n{heading}{begin}\n{end}\n"
        text = with_part(text, name, PROGRAM, part, page=path.name)
    write_text(path, text)


def figures_table(gallery: Gallery, earlier: Gallery | None = None) -> str:
    """Return the figures of all scenes as a table; those of an earlier gallery in brackets."""
    lines = [
        "| Scene | Held out | Training views | SSIM | Worst view | Gaussians | CPU time | Preset | Version |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    columns: tuple[Callable[[SceneFigures], str], ...] = (
        lambda row: _decibels(row.psnr),
        lambda row: _decibels(row.training_psnr),
        lambda row: _share(row.ssim),
        lambda row: _decibels(row.worst_now.psnr),
        lambda row: f"{row.gaussians:,}",
        lambda row: "not measured" if row.cpu_seconds is None else f"{row.cpu_seconds:,.0f} s",
        lambda row: row.preset,
        lambda row: f"{row.version}, results {row.results_version}",
    )
    for name, scene in SCENES.items():
        if name not in gallery.scenes:
            continue
        row, before = gallery.scenes[name], None if earlier is None else earlier.scenes.get(name)
        cells = []
        for column in columns:
            now, then = column(row), "" if before is None else column(before)
            cells.append(f"{now} ({then})" if then and then != now else now)
        about = f"{scene.title}: {row.photographs} photographs, {row.held_out} held out"
        lines.append(f"| {' | '.join([about, *cells])} |")
    return "\n".join(lines)


def scene_part(name: str, figures: SceneFigures, earlier: SceneFigures | None = None) -> str:
    """Return what a scene is, and its pictures; with those of an earlier gallery below each."""
    lines = [SCENES[name].about, ""]
    for strip in STRIPS:
        caption = _caption(strip, figures)
        lines += [f"{caption}:", "", f"![{caption}]({(PICTURES / f'{name}_{strip}.jpg').as_posix()})", ""]
        if earlier is not None:
            then = _caption(strip, earlier)
            picture = (PICTURES / EARLIER / f"{name}_{strip}.jpg").as_posix()
            version = f"{earlier.version}, results {earlier.results_version}"
            lines += [f"Earlier ({version}). {then}:", "", f"![Earlier. {then}]({picture})", ""]
    return "\n".join(lines[:-1])


def _caption(strip: str, figures: SceneFigures) -> str:
    if strip == "between":
        return f"{STRIPS[strip]}, {' and '.join(figures.between)}"
    shown: ShownView = getattr(figures, strip)
    return f"{STRIPS[strip]}, {shown.name}, {_decibels(shown.psnr)}, SSIM {_share(shown.ssim)}"


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f} dB"


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the scenes that are asked for, one after the other, and the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", metavar="NAME", choices=SCENES, help=f"of {', '.join(SCENES)}")
    parser.add_argument("--preset", choices=PRESETS, default="fast")
    parser.add_argument("-o", "--output", type=Path, default=DOCS, help="a folder, docs/ if left out")
    parser.add_argument("--compare", type=Path, metavar="FOLDER", help="of an earlier gallery")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keeps photographs and runs")
    parser.add_argument("--choose-views", action="store_true", help="choose the views to show anew")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args(arguments)
    if given.compare is not None and given.compare.resolve() == given.output.resolve():
        parser.error("--compare names the gallery to be written; write to another folder with -o")
    use_threads(given.threads)
    earlier = None if given.compare is None else read_gallery(given.compare, needed=True)
    names = [name for name in given.scenes or SCENES if _is_possible(name)]
    if earlier is not None:
        copy_earlier(given.compare, given.output, names)
    runs = given.runs or RUNS
    for name in names:
        train(name, runs / name, given.preset, given.threads)
        gallery = read_gallery(given.output)
        known = None if given.choose_views else (earlier or gallery).scenes.get(name)
        figures = scene_figures(runs / name, given.preset, known)
        write_strips(runs / name, figures, given.output / PICTURES, name, given.threads)
        gallery = Gallery(scenes={**gallery.scenes, name: figures})
        write_json(given.output / PICTURES / FIGURES, gallery.model_dump(mode="json"))
        write_page(given.output, gallery, earlier)
        print(f"{name}: {_decibels(figures.psnr)} held out", flush=True)
    if given.runs is None:
        for name in names:
            shutil.rmtree(runs / name, ignore_errors=True)


def _is_possible(name: str) -> bool:
    """Return whether a scene can be made here, and tell if not."""
    if available(SCENES[name]):
        return True
    print(f"{name}: left out, as {SCENES[name].needs} is not installed", flush=True)
    return False


if __name__ == "__main__":
    main()
