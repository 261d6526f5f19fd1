"""Exports that are killed leave a file or folder beside theirs, which the next one there removes."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.partial_folders import partial_folder

KILLED = """
import os, signal, sys
import octasplat as osp
import octasplat.engine.{module} as module

def die(*_values, **_named):
    os.kill(os.getpid(), signal.SIGKILL)

module.{function} = die
{call}
"""
EXPORT = "osp.export('scene.ply', 'out/{name}')"
MOVE = "osp.transform('run', 'out/moved', scale=2)"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, as the current one."""
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(3)
    scene = osp.Scene.from_arrays(
        means=random.normal(size=(50, 3)),
        quats=random.normal(size=(50, 4)),
        scales=np.full((50, 2), 0.1),
        opacities=np.full(50, 0.8),
        sh=random.normal(size=(50, 1, 3)),
    )
    osp.save(scene, "scene.ply")
    Path("run").mkdir()
    osp.save(scene, "run/scene.ply")
    return tmp_path


def kill(module: str, function: str, call: str) -> None:
    """Run a call in a process that is killed as it calls a function."""
    program = KILLED.format(module=module, function=function, call=call)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.mark.parametrize(
    ("module", "function", "call"),
    [
        ("files.tiles_3d", "_write_content", EXPORT.format(name="tileset.json")),
        ("files.usd", "_write_stage", EXPORT.format(name="scene.usdc")),
        ("edit.changed_run", "write_gaussian_ply", MOVE),
    ],
)
def test_folder_of_a_killed_export_is_removed_by_the_next_one(
    folder: Path, module: str, function: str, call: str
) -> None:
    if module == "files.usd":
        pytest.importorskip("pxr")
    kill(module, function, call)
    [left] = (folder / "out").iterdir()
    assert left.name.startswith(".") and left.name.endswith(".partial") and left.is_dir()
    osp.export("scene.ply", "out/tileset.json")
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["tiles", "tileset.json"]


def test_file_of_a_killed_export_is_removed_by_the_next_one(folder: Path) -> None:
    kill("files.splat", "_splat_rows", EXPORT.format(name="scene.splat"))
    [left] = (folder / "out").iterdir()
    assert left.name.startswith(".scene.") and left.name.endswith(".partial.splat")
    osp.export("scene.ply", "out/scene.splat")
    assert left.exists()  # just written: another host may be at it, which has its own numbers of processes
    os.utime(left, (0, 0))
    others = [Path(f"out/{name}") for name in (".other.9.partial.splat", ".scene.1.partial.splat")]
    for other in others:
        other.touch()
        os.utime(other, (0, 0))
    osp.export("scene.ply", "out/scene.splat")
    assert not left.exists() and all(other.exists() for other in others)


def test_folders_that_are_in_use_or_of_others_stay(folder: Path) -> None:
    others = [Path("out/.scene.partial"), Path("out/.scene.ply.12.abcdefgh.partial"), Path("out/octasplat-1")]
    for other in others:
        other.mkdir(parents=True)
    with partial_folder(folder / "out" / "other.json") as used:
        (used / "part.glb").touch()
        osp.export("scene.ply", "out/tileset.json")
        assert (used / "part.glb").exists()
    assert not used.exists() and all(other.is_dir() for other in others)


def test_link_in_the_place_of_a_folder_is_not_followed(folder: Path) -> None:
    Path("photos").mkdir()
    Path("photos/a.jpg").touch()
    Path("out").mkdir()
    Path("out/.scene.ply.12.0123abcd.partial").symlink_to(folder / "photos")
    osp.export("scene.ply", "out/tileset.json")
    assert Path("photos/a.jpg").exists()
