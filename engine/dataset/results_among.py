"""Result folders of runs inside a folder of photographs."""

from pathlib import Path

from octasplat.engine.core.scene_layout import RUN_FILES


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder is a run folder, whose renders and layers are not photographs."""
    return all((folder / name).is_file() for name in RUN_FILES)
