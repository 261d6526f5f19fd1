"""Named channels go wherever their Gaussians go: every operation is tried on a scene that has some.

The constant harmonic of Gaussian k is k, which no operation here changes; so the channels of each result can
be compared with those that this Gaussian began with.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree

from octasplat.engine.edit.cleaning import clean
from octasplat.engine.edit.deform import deform
from octasplat.engine.edit.edit_options import CleanupOptions
from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
from octasplat.engine.edit.selection import in_box
from octasplat.engine.files import (
    dropped_on_export,
    export_scene,
    exporters,
    importers,
    read_mesh,
    read_scene,
)
from octasplat.engine.files.encodings import half_turn_gaussians
from octasplat.engine.gaussians.affine import rotation, transform_gaussians, translation
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.merge import merge_scenes, with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.morton import morton_order
from octasplat.engine.gaussians.octagon import SIDES, octagon_triangles
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA
from octasplat.engine.train.config import McmcConfig, RedisplatsConfig
from octasplat.engine.train.densify import McmcDensifier, RedisplatsDensifier
from octasplat.engine.train.loop.checkpoint import (
    BestState,
    load_best,
    load_checkpoint,
    save_best,
    save_checkpoint,
)
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.optimization.adam import Adam
from octasplat.workers.cli.main import cli
from tests.support.planar_dataset import PlanarDataset, small_config

COUNT = 120
RNG = np.random.default_rng(7)
CHANNELS = {
    "label": np.arange(COUNT, dtype=np.float32)[:, None],
    "albedo": RNG.random((COUNT, 3), np.float32),
    "spectrum": RNG.random((COUNT, 6), np.float32),
}
Operation = Callable[[FlatGaussians, Path], FlatGaussians]


def scene() -> FlatGaussians:
    sh = np.zeros((COUNT, 4, 3), np.float32)
    sh[:, 0] = CHANNELS["label"]
    sh[:, 1:] = RNG.random((COUNT, 3, 3), np.float32)
    return FlatGaussians(
        means_world=RNG.uniform(-1, 1, (COUNT, 3)).astype(np.float32),
        quats_wxyz=RNG.standard_normal((COUNT, 4)).astype(np.float32),
        log_scales=RNG.uniform(-3, -2, (COUNT, 2)).astype(np.float32),
        opacity_logits=RNG.uniform(-1, 4, COUNT).astype(np.float32),
        sh=sh,
        channels=Channels({name: array.copy() for name, array in CHANNELS.items()}),
    )


def assert_right_rows(result: FlatGaussians, *, near: FlatGaussians | None = None) -> None:
    """Channels are those of their rows, told by color or, where a file rounds that, by place."""
    assert len(result) > 0
    rows = result.sh[:, 0, 0].astype(np.int64)
    if near is not None:
        rows = cKDTree(near.means_world).query(result.means_world)[1]
    assert list(result.channels) == list(CHANNELS)
    for name, array in CHANNELS.items():
        np.testing.assert_array_equal(result.channels[name], array[rows], err_msg=name)


def put(g: FlatGaussians, _folder: Path) -> FlatGaussians:
    g.put(np.array([3, 5, 8]), g.select(np.array([100, 7, 3])))
    assert g.channels["label"][[3, 5, 8], 0].tolist() == [100, 7, 3]
    return g


def densified(densifier: McmcDensifier | RedisplatsDensifier, g: FlatGaussians) -> FlatGaussians:
    result, adam = densifier.apply(g, Adam.zeros(g), np.random.default_rng(0), extent=1.0)
    assert len(adam.first) == len(result) != COUNT
    return result


def mcmc(g: FlatGaussians, _folder: Path) -> FlatGaussians:
    g.opacity_logits[::5] = -12.0  # dead ones move to others and take their channels over
    moved = g.sh[::5, 0, 0].copy()
    result = densified(McmcDensifier(McmcConfig(growth=0.3), iterations=100, max_gaussians=1000), g)
    assert (result.sh[:COUNT:5, 0, 0] != moved).all()
    return result


def paper(g: FlatGaussians, _folder: Path) -> FlatGaussians:
    densifier = RedisplatsDensifier(RedisplatsConfig(), iterations=100, max_gaussians=1000)
    steps = np.zeros((COUNT, 3), np.float32)
    steps[::3] = 1.0
    densifier.restore({"steps": steps})
    g.opacity_logits[1::7] = -12.0
    return densified(densifier, g)


def state_of(g: FlatGaussians) -> TrainState:
    return TrainState(3, g, Adam.zeros(g), np.random.default_rng(0), {})


def best(g: FlatGaussians, folder: Path) -> FlatGaussians:
    save_best(BestState(g, {}), folder)
    return load_best(folder).gaussians


def deformed(g: FlatGaussians, _folder: Path) -> FlatGaussians:
    result, report = deform(g, lambda points: points * [1.0, 1.0, 1.0] + 0.3 * points[..., :1] ** 2)
    assert report.moved > 0
    return result


def edited(g: FlatGaussians, folder: Path) -> FlatGaussians:
    """Octagons moved, deleted and duplicated; some Gaussians are too faint to have one."""
    g.opacity_logits[::11] = -9.0
    export_scene(g, folder / "a.mesh.ply")
    mesh = read_mesh(folder / "a.mesh.ply")
    assert mesh.gid is not None and mesh.corner is not None
    kept = np.flatnonzero(mesh.gid != 17)
    again = np.flatnonzero((mesh.gid > 30) & (mesh.gid < 40))
    rows = np.concatenate([kept, again])
    vertices = mesh.vertices[rows]
    vertices[len(kept) :] += [0.0, 0.0, 5.0]
    vertices[mesh.gid[rows] > 90] += [0.0, 2.0, 0.0]
    changed = replace(
        mesh, vertices=vertices, triangles=octagon_triangles(len(rows) // SIDES), gid=mesh.gid[rows],
        corner=mesh.corner[rows], uv=None, radius=None,
    )  # fmt: skip
    result, report = recover_gaussians(g, changed, folder / "a.mesh.ply")
    assert report.deleted == 1 and report.copies > 0 and report.moved > 0 and report.carried > 0
    return result


def dropped(g: FlatGaussians, folder: Path) -> FlatGaussians:
    """A Gaussian that is not finite is left out on the way in."""
    export_scene(g, folder / "a.ply")
    content = bytearray((folder / "a.ply").read_bytes())
    row = (len(content) - content.index(b"end_header\n") - 11) // COUNT
    content[-5 * row : -5 * row + 4] = np.float32(np.nan).tobytes()
    (folder / "b.ply").write_bytes(content)
    result, report = read_scene(folder / "b.ply", drop_invalid=True)
    assert report.dropped == 1
    return result


OPERATIONS: dict[str, Operation] = {
    "select by numbers": lambda g, _: g.select(np.array([9, 4, 4, 100])),
    "select by mask": lambda g, _: g.select(g.means_world[:, 0] > 0),
    "select by slice": lambda g, _: g.select(slice(5, 50)),
    "view": lambda g, _: g.view(slice(5, 50)),
    "copy": lambda g, _: g.copy(),
    "put": put,
    "concatenate": lambda g, _: concatenate([g.select(slice(50, 60)), g]),
    "order in space": lambda g, _: g.select(morton_order(g.means_world)),
    "relocate and grow": mcmc,
    "clone, split, prune": paper,
    "checkpoint": lambda g, f: load_checkpoint(save_checkpoint(state_of(g), f, "x"), "x").gaussians,
    "best": best,
    "crop": lambda g, _: g.select(in_box(g, np.zeros(3), np.ones(3))),
    "clean": lambda g, _: g.select(clean(g, CleanupOptions(min_opacity=0.5))[0]),
    "merge": lambda g, _: merge_scenes([g.select(slice(40, None)), g]),
    "fewer harmonics": lambda g, _: with_sh_degree(g, 0),
    "move": lambda g, _: transform_gaussians(g, translation(np.array([1.0, 2, 3]))),
    "turn": lambda g, _: transform_gaussians(g, rotation(np.array([1.0, 2, 3]), 40.0)),
    "turn to y up": lambda g, _: half_turn_gaussians(g),
    "deform": deformed,
    "edit": edited,
    "drop what is not finite": dropped,
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_channels_stay_with_their_gaussians(name: str, tmp_path: Path) -> None:
    assert_right_rows(OPERATIONS[name](scene(), tmp_path))


READ = {importer.name for importer in importers()}
BOTH_WAYS = [each for each in exporters() if each.holds_channels and each.name in READ]


@pytest.mark.parametrize("exporter", BOTH_WAYS, ids=lambda each: each.name)
def test_channels_come_back_from_files(exporter: object, tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    exported = scene()
    export_scene(exported, path, format=exporter.name)
    assert_right_rows(read_scene(path)[0], near=exported if exporter.name == "mesh-ply" else None)
    assert read_scene(path, channels=())[0].channels.widths == {}
    assert read_scene(path, channels=("albedo",))[0].channels.widths == {"albedo": 3}


@pytest.mark.parametrize("exporter", exporters(), ids=lambda each: each.name)
def test_formats_keep_channels_or_warn(exporter: object) -> None:
    told = [text for text in dropped_on_export(scene(), [Path("a.x")], exporter.name) if "channels" in text]
    place = exporter.find_place_losses(UNKNOWN_METADATA)
    assert dropped_on_export(scene().with_base_color_only(), [Path("a.x")], exporter.name) == place
    if exporter.holds_channels:
        assert told == []
    else:
        (text,) = told
        assert f"format {exporter.name} " in text and "label, albedo, spectrum" in text


def test_export_to_several_formats_warns_once() -> None:
    paths = [Path("mesh.ply"), Path("mesh.glb"), Path("a.splat"), Path("scene.ply"), Path("mesh.obj")]
    channels, harmonics = dropped_on_export(scene(), paths)
    assert channels.startswith("The formats splat and obj have no place for named channels")
    assert harmonics.startswith("The formats mesh-ply, glb, splat and obj have one color")


def test_missing_channel_is_zero(tmp_path: Path) -> None:
    whole = scene()
    result = merge_scenes([whole.without_channels(["albedo"]), whole])
    assert result.channels.widths == {"label": 1, "spectrum": 6, "albedo": 3}
    np.testing.assert_array_equal(result.channels["albedo"][:COUNT], 0)
    np.testing.assert_array_equal(result.channels["albedo"][COUNT:], CHANNELS["albedo"])
    np.testing.assert_array_equal(result.channels["label"], np.tile(CHANNELS["label"], (2, 1)))


def test_training_takes_channels_along(tmp_path: Path) -> None:
    """Rotations are not trained here, and so say whose channels a Gaussian should have."""
    world = PlanarDataset()
    start = world.initial_gaussians()
    start.quats_wxyz[:] = np.random.default_rng(0).standard_normal(start.quats_wxyz.shape)
    names = np.arange(len(start), dtype=np.float32)[:, None]
    first = start.copy().with_channels({"label": names})
    config = small_config(iterations=60)
    config = config.model_copy(update={"lr": config.lr.model_copy(update={"quat": 0.0})})
    trainer = Trainer(
        world, config, initial_state(first, 0), folder=tmp_path, fingerprint="", progress=lambda _event: None,
        threads=1,
    )  # fmt: skip
    result = trainer.run()
    assert len(result) > len(start)
    rows = result.channels["label"][:, 0].astype(np.int64)
    np.testing.assert_allclose(result.rotations, start.rotations[rows], atol=1e-6)


def test_commands_take_channels_along_and_warn_once(tmp_path: Path) -> None:
    source = tmp_path / "scene.ply"
    export_scene(scene(), source)

    def run(*arguments: object) -> str:
        done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
        assert done.exit_code == 0, done.output
        return done.stderr

    assert run("crop", source, "-o", tmp_path / "a.ply", "--sphere", 0, 0, 0, 0.9) == ""
    assert_right_rows(read_scene(tmp_path / "a.ply")[0])
    assert run("transform", source, "-o", tmp_path / "b.splats.glb", "--scale", 2) == ""
    assert_right_rows(read_scene(tmp_path / "b.splats.glb")[0])
    bare = tmp_path / "bare.ply"
    export_scene(scene().with_base_color_only(), bare)
    assert "bare.ply: has no channel label, albedo, spectrum; it is 0" in run(
        "merge", source, bare, "-o", tmp_path / "c.ply"
    )
    assert run("export", source, tmp_path / "d.spz").count("label, albedo, spectrum will be left out") == 1
    export_scene(read_scene(source)[0], tmp_path / "scene.mesh.ply")
    mesh = tmp_path / "scene.mesh.ply"
    told = run("edit", source, "--mesh", mesh, "--mesh", mesh, "-o", tmp_path / "e_%02d.splat")
    assert told.count("named channels") == told.count("direction will be left out") == 1
