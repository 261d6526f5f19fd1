"""Photographs as COLMAP is given them."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
from PIL import ExifTags, Image

from octasplat.engine.core.events import Event, PhaseFinished, PhaseProgress, PhaseStarted
from octasplat.engine.poses.features import create_database
from octasplat.engine.poses.pair_proposals import gps_positions_m
from octasplat.engine.poses.workspace import link_photographs

NAMES = ("a.jpg", "b.webp", "c.png", "d.webp")


def write_photographs(folder: Path, exif: bytes = b"") -> None:
    folder.mkdir()
    for name in NAMES:
        Image.fromarray(np.full((48, 64, 3), 99, np.uint8)).save(folder / name, exif=exif)


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


def test_copied_photographs_keep_gps_and_focal_length(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(
        {1: "N", 2: (47.0, 10.0, 1.0), 3: "E", 4: (8.0, 1.0, 2.0), 5: b"\0", 6: 400.0}
    )
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    write_photographs(tmp_path / "images", exif.tobytes())
    aliases = link_photographs(tmp_path / "images", NAMES, tmp_path / "linked")
    create_database(tmp_path / "database.db", tmp_path / "linked", aliases, one_camera=False)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        places_m = gps_positions_m(database)
        assert [camera.has_prior_focal_length for camera in database.read_all_cameras()] == [True] * 4
    assert sorted(places_m) == [1, 2, 3, 4]
    np.testing.assert_allclose(places_m[2], places_m[1])


def test_copied_photographs_without_exif_have_none(tmp_path: Path) -> None:
    (tmp_path / "linked").mkdir()
    spec = oiio.ImageSpec(64, 48, 3, "half")
    for name in ("a.exr", "b.hdr"):
        oiio.ImageBuf(spec).write(str(tmp_path / name))
    assert len(link_photographs(tmp_path, ("a.exr", "b.hdr"), tmp_path / "linked")) == 2
