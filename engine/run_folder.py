"""The folder of a run: the names of its files, and what its photographs are and were taken from."""

import json
from pathlib import Path

from engine.config import read_config
from engine.errors import ConfigError, DatasetError
from engine.scene import load_scene
from engine.scene.views_file import SplitViewpoints, read_views, scene_viewpoints

CONFIG, EVENTS, HELD_OUT, SCENE, TRAINING, VIEWS = (
    "config.json", "events.jsonl", "held_out.json", "scene.ply", "training.json", "views.json",
)  # fmt: skip
CHECKPOINTS, CACHE, POSES = "checkpoints", "cache", "poses"
ENVIRONMENT = "environment.hdr"


def is_run(source: Path) -> bool:
    """Whether a command was given the folder of a run, not a file or the folder of an unpacked SOG."""
    return source.is_dir() and not (source / "meta.json").exists()


def run_scene(output: Path) -> Path:
    """The scene folder that a run was made from.

    Raises:
        ConfigError: ``output`` is no run.
    """
    try:
        return Path(json.loads((output / CONFIG).read_text(encoding="utf-8"))["scene"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{output / CONFIG} cannot be read ({error}); name the folder of a run.") from None


def photographs_folder(output: Path, scene: Path | None = None) -> Path:
    """The folder of a run's photographs: ``scene`` if given, or else where they were.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: they are not there any more, or were never on this machine.
    """
    if scene is not None:
        return scene
    noted = run_scene(output)
    if noted.is_absolute() and noted.is_dir():
        return noted
    raise DatasetError(
        f"The photographs that {output} was made from ({noted}) are not on this machine; "
        "say where they are with --scene FOLDER."
    )


def run_viewpoints(
    output: Path, *, scene: Path | None = None, max_side: int | None = None
) -> SplitViewpoints:
    """Where the photographs of a run were taken from; the photographs themselves are not needed.

    Args:
        output: folder of the run.
        scene: photographs whose cameras to take instead of those that the run keeps.
        max_side: cap on the longer side of the views, px; None takes the run's.

    Raises:
        ConfigError: ``output`` is no run.
        DatasetError: the run keeps no cameras, as runs of old, and the photographs cannot be used.
    """
    config = read_config(output / CONFIG)
    max_side = max_side or config.max_side
    if scene is None and (output / VIEWS).exists():
        return read_views(output / VIEWS).viewpoints(max_side)
    photographs = load_scene(
        photographs_folder(output, scene), max_side=max_side, model_folder=found_model(output)
    )
    return scene_viewpoints(photographs, config.test_every, config.held_out)


def found_model(output: Path) -> Path | None:
    """The folder of the poses that were found for the photographs of a run, if they had to be."""
    for folder in (output / POSES, output / POSES / "sparse" / "0"):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    return None
