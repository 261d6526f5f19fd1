"""``octasplat reconstruct``: the main job."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octasplat.engine.train.preset_names import PRESETS
from octasplat.workers.cli.options import (
    background_option,
    export_names,
    exports_option,
    quiet_option,
    threads_option,
)

if TYPE_CHECKING:
    from octasplat.engine.config import ReconstructionConfig

_NOT_SETTINGS = ("scene", "output", "threads", "resume", "quiet", "exports")


@click.command(short_help="Photographs to a scene, its meshes, and measurements.")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="Folder for the results."
)
@click.option(
    "--preset", type=click.Choice(PRESETS), help="Where the settings come from.  [default: standard]"
)
@click.option(
    "--poses",
    type=click.Choice(["given", "auto", "missing"]),
    help="Take the poses of the COLMAP model (photographs far from where matches put them are moved, see "
    "place_misfits), find all, or find them if it is missing.  [default: given]",
)
@click.option("--max-side", type=int, metavar="PX", help="Shrink photographs to this longer side.")
@click.option(
    "--iterations", type=int, metavar="N", help="Iterations of the training; 0 asks the photographs' pixels."
)
@click.option(
    "--minutes",
    type=click.FloatRange(0.1),
    metavar="N",
    help="End the training within N minutes on this machine: chooses iterations and Gaussians by its pace.",
)
@click.option("--rays", type=int, metavar="N", help="Rays of one iteration.")
@click.option(
    "--max-gaussians",
    type=int,
    metavar="N",
    help="Most Gaussians; 0, the default, asks the photographs' pixels.",
)
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), help="Degree of the spherical harmonics of the colours."
)
@click.option(
    "--test-every", type=int, metavar="N", help="Hold out every N-th view; 0 for none.  [default: 8]"
)
@click.option(
    "--held-out", multiple=True, metavar="NAME", help="Hold out this view instead; may be repeated."
)
@click.option(
    "--masks",
    type=click.Choice(["ignore", "alpha"]),
    help="Leave masked pixels out, or take the mask as the object's alpha.  [default: ignore]",
)
@click.option(
    "--materials",
    is_flag=True,
    help="Learn materials and the environment of shiny things; environment.hdr lies beside the scene then.",
)
@click.option(
    "--for-surface",
    is_flag=True,
    help="Hold normals and depths together, so that octasplat surface gives a smoother mesh.",
)
@background_option("Behind renders and photographs with alpha in the evaluation.  [default: black]")
@exports_option
@click.option("--seed", type=int, metavar="N", help="Seed of everything random.  [default: 0]")
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="NAME=VALUE",
    help="Any other setting as in config.json, e.g. rates.quat=0.02; may be repeated.",
)
@click.option("--resume", is_flag=True, help="Go on with the run in the output folder, if there is one.")
@threads_option
@quiet_option
def reconstruct(**options: Any) -> None:
    """Reconstruct SCENE, a folder with images/ and a COLMAP model in sparse/0.

    With --poses auto it may hold photographs alone, in images/ or by themselves: COLMAP finds their poses.

    The output folder gets scene.ply, meshes, metrics.json, report.html, renders of the held-out views and
    checkpoints. Ctrl-C stops after writing a checkpoint; the same command with --resume goes on.
    """
    from octasplat.workers.cli.reconstruction import run_reconstruction

    output: Path = options["output"]
    run_reconstruction(
        options["scene"],
        output,
        _config(output, options),
        resume=options["resume"],
        threads=options["threads"],
        quiet=options["quiet"],
    )


def _config(output: Path, options: dict[str, Any]) -> "ReconstructionConfig":
    """The settings asked for; with ``--resume`` and none given, those of the run."""
    from octasplat.engine.config import read_config, resolve_config
    from octasplat.engine.train.config import FOR_SURFACE

    given = any(
        value not in (None, (), False) for name, value in options.items() if name not in _NOT_SETTINGS
    )
    exports = export_names(options["exports"])
    if options["resume"] and not given and (output / "config.json").exists():
        config = read_config(output / "config.json")
        return config if exports is None else config.model_copy(update={"exports": exports})
    direct = ("iterations", "rays", "max_gaussians", "sh_degree", "seed")
    assignments = [f"{name}={options[name]}" for name in direct if options[name] is not None]
    if options["for_surface"]:
        assignments.append(f"loss.depth_normal={FOR_SURFACE}")
    return resolve_config(
        options["preset"] or "standard",
        materials=options["materials"],
        settings={
            "max_side": options["max_side"],
            "poses": options["poses"],
            "test_every": options["test_every"],
            "held_out": options["held_out"] or None,
            "masks": options["masks"],
            "evaluate_background": options["background"],
            "minutes": options["minutes"],
            "exports": exports,
        },
        assignments=[*assignments, *options["assignments"]],
    )
