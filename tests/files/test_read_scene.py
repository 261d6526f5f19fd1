from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.events import Event, PhaseFinished, PhaseStarted
from octasplat.engine.files import (
    ExportOptions,
    Importer,
    export_scene,
    importer_for,
    importers,
    read_metadata,
    read_scene,
    register,
)
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata


@pytest.fixture
def gaussians() -> FlatGaussians:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    return FlatGaussians(normal(30, 3), normal(30, 4), normal(30, 2) - 3, normal(30), normal(30, 4, 3))


def test_formats_are_found_by_themselves_and_have_names_of_their_own() -> None:
    assert "gaussians" in {importer.name for importer in importers()}
    assert all(importer.description and importer.patterns for importer in importers())
    with pytest.raises(ValueError, match="'gaussians' is registered already"):
        register(Importer("gaussians", ("*.x",), "another", importers()[0].read))


@pytest.mark.parametrize("written", ["a.ply", "a.splats.glb"])
@pytest.mark.parametrize("name", ["scene.ply", "scene.splat", "scene.data", "scene.glb"])
def test_read_scene_detects_format_by_content(
    gaussians: FlatGaussians, tmp_path: Path, written: str, name: str
) -> None:
    facts = SceneMetadata(origin_world=(512_345.0, 5_403_210.0, 310.0))
    export_scene(gaussians, tmp_path / written, ExportOptions(facts=facts))
    (tmp_path / written).rename(tmp_path / name)
    assert importer_for(tmp_path / name).name == ("gaussians" if written == "a.ply" else "khr-glb")
    assert read_metadata(tmp_path / name) == facts
    back, report = read_scene(tmp_path / name)
    np.testing.assert_array_equal(back.sh, gaussians.sh)
    assert (report.count, report.sh_degree, report.flattened, report.dropped) == (30, 1, 0, 0)


def test_run_folder_is_read_as_scene(gaussians: FlatGaussians, tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"is a folder without a scene; it should hold scene\.ply"):
        read_scene(tmp_path)
    write_gaussian_ply(gaussians, tmp_path / "scene.ply")
    np.testing.assert_array_equal(read_scene(tmp_path)[0].means_world, gaussians.means_world)


def test_unknown_files_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"none\.ply: cannot be read \(No such file"):
        read_scene(tmp_path / "none.ply")
    (tmp_path / "a.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(
        SceneFileError, match=r"a\.fbx: is no scene of a known format; .*gaussians \(\*\.ply\)"
    ):
        read_scene(tmp_path / "a.fbx")
    with pytest.raises(SceneFileError, match=r"no import format 'fbx'; choose one of .*gaussians"):
        read_scene(tmp_path / "a.fbx", "fbx")


def test_read_scene_reports_progress_events(gaussians: FlatGaussians, tmp_path: Path) -> None:
    write_gaussian_ply(gaussians, tmp_path / "a.ply")
    events: list[Event] = []
    read_scene(tmp_path / "a.ply", progress=events.append)
    assert [type(event) for event in events] == [PhaseStarted, PhaseFinished]


def test_gaussians_without_finite_values_can_be_left_out(gaussians: FlatGaussians, tmp_path: Path) -> None:
    write_gaussian_ply(gaussians, tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    rows = np.frombuffer(data, "<f4", offset=data.index(b"end_header\n") + 11).reshape(30, -1)
    rows[3, 0] = np.nan  # position
    rows[7, -4:] = 0.0  # rotation
    rows[9, -5] = np.inf  # scale
    rows[11, 10] = np.nan  # color
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(SceneFileError, match=r"1 of 30 Gaussians have no finite position; .*--drop-invalid"):
        read_scene(tmp_path / "a.ply")
    back, report = read_scene(tmp_path / "a.ply", drop_invalid=True)
    assert (report.dropped, report.count, len(back)) == (4, 26, 26)
    np.testing.assert_array_equal(back.means_world, np.delete(gaussians.means_world, [3, 7, 9, 11], axis=0))
    rows[:, 0] = np.nan
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(SceneFileError, match="none of its 30 Gaussians"):
        read_scene(tmp_path / "a.ply", drop_invalid=True)


def test_infinitely_thin_gaussian_is_read(gaussians: FlatGaussians, tmp_path: Path) -> None:
    def read(_path: Path) -> GaussianCloud:
        scales = np.stack([gaussians.log_scales[:, 1], np.full(30, -np.inf), gaussians.log_scales[:, 0]], 1)
        return GaussianCloud(
            gaussians.means_world,
            gaussians.quats_wxyz,
            scales.astype(np.float32),
            gaussians.opacity_logits,
            gaussians.sh,
            ("Something was left out.",),
        )

    register(Importer("thin-for-a-test", ("*.thin",), "a test's", read))
    (tmp_path / "a.thin").touch()
    back, report = read_scene(tmp_path / "a.thin")
    np.testing.assert_array_equal(back.log_scales, gaussians.log_scales)
    np.testing.assert_allclose(back.rotations[:, :, 0], gaussians.rotations[:, :, 1], atol=1e-6)
    assert (report.flattened, report.thick, report.notes) == (0, 0, ("Something was left out.",))
