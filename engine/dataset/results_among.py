"""Result folders of runs inside a folder of photographs."""

from pathlib import Path


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder is a run folder, whose renders and layers are not photographs."""
    return (folder / "config.json").is_file() and (folder / "events.jsonl").is_file()
