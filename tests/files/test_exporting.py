from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import read_ply_header
from octasplat.engine.files import Exporter, ExportOptions, export_scene, exporter_for, exporters, register
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians

Make = Callable[..., FlatGaussians]
ALL = ("scene.ply", "mesh.ply", "scene.obj", "scene.glb")


def test_exporters_are_discovered() -> None:
    assert {exporter.name for exporter in exporters()} >= {"gaussians", "mesh-ply", "obj", "glb"}
    assert all(exporter.description and exporter.patterns for exporter in exporters())


@pytest.mark.parametrize(
    ("name", "format"),
    [
        ("scene.ply", "gaussians"),
        ("point_cloud.PLY", "gaussians"),
        ("meshes.ply", "gaussians"),
        ("mesh.ply", "mesh-ply"),
        ("Mesh.ply", "mesh-ply"),
        ("fox.mesh.ply", "mesh-ply"),
        ("fox_mesh.ply", "mesh-ply"),
        ("fox-mesh.ply", "mesh-ply"),
        ("mesh.obj", "obj"),
        ("a.b.glb", "glb"),
    ],
)
def test_export_format_follows_suffix(name: str, format: str) -> None:
    assert exporter_for(Path("some/where") / name).name == format


def test_export_explicit_format_overrides_suffix() -> None:
    assert exporter_for(Path("scene.ply"), "mesh-ply").name == "mesh-ply"
    assert exporter_for(Path("mesh.ply"), "gaussians").name == "gaussians"


def test_unknown_formats_list_the_known_ones() -> None:
    with pytest.raises(SceneFileError, match=r"scene\.fbx: .*glb \(\*\.glb\)"):
        exporter_for(Path("scene.fbx"))
    with pytest.raises(SceneFileError, match=r"no export format 'fbx'; choose one of .*glb"):
        exporter_for(Path("scene.glb"), "fbx")


def test_exporter_duplicate_name_is_refused() -> None:
    glb = exporter_for(Path("a.glb"))
    with pytest.raises(ValueError, match="glb"):
        register(Exporter("glb", ("*.x",), "another", glb.write))


@pytest.mark.parametrize("name", ALL)
def test_exporters_return_exactly_written_files(make_scene: Make, tmp_path: Path, name: str) -> None:
    written = export_scene(make_scene(20), tmp_path / "new" / name)
    assert written[0] == tmp_path / "new" / name
    assert set(written) == set((tmp_path / "new").iterdir())


@pytest.mark.parametrize("name", ALL)
def test_failed_export_leaves_no_file(make_scene: Make, tmp_path: Path, name: str) -> None:
    scene = make_scene(5)
    empty = scene.select(np.arange(0))
    broken = scene.copy()
    broken.means_world[1, 1] = np.nan
    for bad, message in ((empty, "not written"), (broken, "not finite")):
        with pytest.raises(SceneFileError, match=message) as caught:
            export_scene(bad, tmp_path / name)
        assert name in str(caught.value)
    scene.opacity_logits[:] = -1.0
    with pytest.raises(SceneFileError, match="not written"):
        export_scene(scene, tmp_path / name, ExportOptions(min_opacity=0.9))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ALL[1:])
def test_octagons_beyond_float32_are_refused(make_scene: Make, tmp_path: Path, name: str) -> None:
    scene = make_scene(5)
    scene.log_scales[3] = 100.0
    with pytest.raises(SceneFileError, match="too large for float32"):
        export_scene(scene, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_min_opacity_leaves_faint_gaussians_out(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(200)
    bright = int((scene.opacities >= 0.5).sum())
    assert 0 < bright < 200
    options = ExportOptions(min_opacity=0.5)
    export_scene(scene, tmp_path / "a.ply", options)
    back, _ = read_gaussian_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.means_world, scene.means_world[scene.opacities >= 0.5])
    export_scene(scene, tmp_path / "mesh.ply", options)
    vertices = read_ply_header(tmp_path / "mesh.ply").element("vertex")
    assert vertices is not None and vertices.count == 8 * bright


def test_padding_reaches_the_gaussian_ply(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(3), tmp_path / "a.ply", ExportOptions(sh_pad_degree=3))
    assert read_gaussian_ply(tmp_path / "a.ply")[1].sh_degree == 3


@pytest.mark.parametrize("bad", [{"q": 0.0}, {"min_opacity": 1.0}, {"sh_pad_degree": 4}, {"texture": 1}])
def test_options_out_of_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        ExportOptions.model_validate(bad)
