"""Folders of results that lie among the photographs that they were made from."""

from pathlib import Path


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder is that of a run, whose renders and layers are no photographs."""
    return (folder / "config.json").is_file() and (folder / "events.jsonl").is_file()
