"""Photographs as COLMAP is given them."""

from pathlib import Path

import numpy as np
from PIL import Image

from octasplat.engine.core.events import Event, PhaseFinished, PhaseProgress, PhaseStarted
from octasplat.engine.poses.workspace import link_photographs

NAMES = ("a.jpg", "b.webp", "c.png", "d.webp")


def write_photographs(folder: Path, **options: object) -> None:
    folder.mkdir()
    for name in NAMES:
        Image.fromarray(np.full((48, 64, 3), 99, np.uint8)).save(folder / name, **options)


def test_photographs_that_are_copied_are_counted(tmp_path: Path) -> None:
    write_photographs(tmp_path / "images")
    heard = list[Event]()
    aliases = link_photographs(tmp_path / "images", NAMES, tmp_path / "linked", heard.append)
    assert aliases == ("000000.jpg", "000001.png", "000002.png", "000003.png")
    assert [path.name for path in sorted((tmp_path / "linked").iterdir()) if not path.is_symlink()] == [
        "000001.png", "000003.png"
    ]  # fmt: skip
    assert heard[:3] == [PhaseStarted("read", 2), PhaseProgress("read", 1, 2), PhaseProgress("read", 2, 2)]
    assert isinstance(heard[3], PhaseFinished) and len(heard) == 4
    heard.clear()
    link_photographs(tmp_path / "images", NAMES[::2], tmp_path / "linked", heard.append)
    assert heard == []
