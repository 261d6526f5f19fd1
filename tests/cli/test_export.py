"""``octasplat export``."""

import json
import re
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from octasplat.engine.core.ply_container import PlyWriteElement, write_ply
from octasplat.engine.files import read_scene
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.render.depth_order import MIN_AGREEMENT, shared_depth_order
from octasplat.engine.runs.run_folder import run_viewpoints


def test_export_ply_to_glb_writes_mesh(run, octasplat, tmp_path):
    target = tmp_path / "scene.glb"
    result = octasplat("export", run.output / "scene.ply", target)
    assert result.exit_code == 0, result.output
    assert str(target) in result.stdout
    content = target.read_bytes()
    length, kind = struct.unpack("<I4s", content[12:20])
    assert (content[:4], kind) == (b"glTF", b"JSON")
    assert json.loads(content[20 : 20 + length])["meshes"]


def glb_json(path):
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[20 : 20 + length])


def test_part_of_an_earlier_larger_scene_is_told(run, octasplat, tmp_path):
    (tmp_path / "a.part2.glb").touch()
    (tmp_path / "a.part2.ply").touch()
    result = octasplat("export", run.output / "scene.ply", tmp_path / "a.glb")
    assert "a.part2.glb was not written now" in " ".join(result.stderr.split())
    assert "part2.ply" not in result.stderr


def test_colors_of_a_run_are_kept_for_later_exports(run, octasplat, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run.output, folder)
    kept = folder / "cache" / "camera_colors.npz"

    def write_scene(seed: int) -> None:
        gaussians, _ = read_gaussian_ply(run.output / "scene.ply")
        random = np.random.default_rng(seed)
        sh = 0.3 * random.standard_normal((len(gaussians), 4, 3)).astype(np.float32)
        write_gaussian_ply(replace(gaussians, sh=sh), folder / "scene.ply")

    def exported(name: str) -> bytes:
        result = octasplat("export", folder, tmp_path / name)
        assert result.exit_code == 0, result.output
        return (tmp_path / name).read_bytes()

    write_scene(0)
    first = exported("first.glb")
    with np.load(kept) as content:
        arrays = dict(content)
    assert exported("second.glb") == first
    # colors that are kept are taken, and no rays traced for them
    np.savez(kept, **{**arrays, "colors": 1 - arrays["colors"]})
    assert exported("inverted.glb") != first
    # those of another scene are not, nor damaged ones
    np.savez(kept, key=np.array("another"), colors=1 - arrays["colors"])
    assert exported("other_key.glb") == first
    kept.write_bytes(kept.read_bytes()[:100])
    assert exported("damaged.glb") == first
    write_scene(1)
    exported("edited.glb")
    with np.load(kept) as content:
        assert str(content["key"]) != str(arrays["key"])


def test_options_reach_a_glb(run, octasplat, tmp_path):
    target = tmp_path / "scene.glb"
    options = ("--opaque", "--chunks", 1, "--falloff-texture-size", 16, "--no-ids")
    result = octasplat("export", run.output / "scene.ply", target, *options)
    assert result.exit_code == 0, result.output
    document = glb_json(target)
    assert document["materials"][0]["alphaMode"] == "MASK"
    (mesh,) = document["meshes"]
    assert "_GID" not in mesh["primitives"][0]["attributes"]
    image = target.read_bytes()[28 + struct.unpack("<I", target.read_bytes()[12:16])[0] :]
    assert struct.unpack(">II", image[16:24]) == (16, 16)  # the PNG's header


def test_help_lists_every_format(octasplat):
    from octasplat.engine.files import exporters

    text = octasplat("export", "--help").stdout
    for exporter in exporters():
        assert re.search(rf"\n  {exporter.name} +{re.escape(exporter.patterns[0])}[,:]", text)


def test_export_opaque_unsupported_format_is_refused(run, octasplat, tmp_path):
    result = octasplat("export", run.output / "scene.ply", tmp_path / "scene.obj", "--opaque")
    assert result.exit_code == 2 and "--opaque is for GLB" in result.stderr
    assert not list(tmp_path.iterdir())


def test_export_obj_prints_all_written_files(run, octasplat, tmp_path):
    result = octasplat("export", run.output / "scene.ply", tmp_path / "scene.obj", "--q", 4)
    assert result.exit_code == 0, result.output
    paths = list(tmp_path.iterdir())
    assert tmp_path / "scene.obj" in paths
    for path in paths:
        assert str(path) in result.stdout


def test_options_reach_a_gaussian_ply(run, octasplat, tmp_path):
    target = tmp_path / "padded.ply"
    result = octasplat("export", run.output / "scene.ply", target, "--sh-pad", 3, "--min-opacity", 0.1)
    assert result.exit_code == 0, result.output
    gaussians, _ = read_gaussian_ply(target)
    assert gaussians.sh_degree == 3
    assert gaussians.opacities.min() >= 0.1
    assert "not flat" not in result.stderr


@pytest.mark.parametrize(("thickness", "warns"), [(0.1, False), (0.9, True)])
def test_export_unflat_scene_warns_of_lost_thickness(octasplat, tmp_path, thickness, warns):
    source = tmp_path / "thick.ply"
    write_thick_gaussians(source, thickness)
    result = octasplat("export", source, tmp_path / "flat.ply")
    assert result.exit_code == 0, result.output
    assert "20 of 20 Gaussians were not flat" in result.stderr and f"{thickness:.2g}" in result.stderr
    assert result.stderr.startswith("Warning: ") == warns


def test_export_format_option_overrides_suffix(run, octasplat, tmp_path):
    target = tmp_path / "mesh.data"
    assert octasplat("export", run.output / "scene.ply", target).exit_code == 1
    assert octasplat("export", run.output / "scene.ply", target, "--format", "glb").exit_code == 0
    assert target.read_bytes()[:4] == b"glTF"


def test_missing_and_wrong_input(octasplat, tmp_path):
    (tmp_path / "text.ply").write_text("hello")
    for name in ("none.ply", "text.ply"):
        result = octasplat("export", tmp_path / name, tmp_path / "out.glb")
        assert result.exit_code == 1
        assert result.stderr.startswith("Error: ") and name in result.stderr
        assert result.stderr.count("\n") == 1


def write_thick_gaussians(path, thickness):
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    rows = np.zeros(20, dtype=[(name, "<f4") for name in names])
    rows["x"] = np.arange(20)
    rows["scale_0"] = np.log(thickness)
    rows["rot_0"] = 1
    write_ply(path, [PlyWriteElement("vertex", len(rows), rows.dtype, iter([rows]))])


def test_single_color_mode_is_applied(run, octasplat, tmp_path):
    colors = {}
    for color in ("constant", "cameras", "0,0,1"):
        path = tmp_path / f"{color}.splat"
        result = octasplat("export", run.output, path, "--color", color)
        assert result.exit_code == 0, result.output
        colors[color] = read_scene(path)[0].base_rgb_srgb
    gaussians = read_scene(run.output)[0]
    if gaussians.sh_degree:
        assert "will be left out" in result.stderr
        assert all(np.abs(colors["constant"] - colors[name]).max() > 0.01 for name in ("cameras", "0,0,1"))
    for text in ("red", "1,2", "0,0,0"):
        result = octasplat("export", run.output, tmp_path / "x.splat", "--color", text)
        assert result.exit_code == 1 and not (tmp_path / "x.splat").exists()


def test_export_for_viewers_sorts_by_cameras(run, octasplat, tmp_path):
    result = octasplat("export", run.output, tmp_path / "a.glb", "--for-viewers", "--chunks", 4)
    assert result.exit_code == 0, result.output
    data = (tmp_path / "a.glb").read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
    first = document["meshes"][0]["primitives"]
    assert [document["materials"][each["material"]]["alphaMode"] for each in first] == ["MASK", "BLEND"]
    assert "_GID" not in first[1]["attributes"]
    back, _ = read_scene(tmp_path / "a.glb")
    seen = run_viewpoints(run.output)
    centres = np.stack([seen.views[index].origin_world for index in seen.train_indices])
    order, agreement = shared_depth_order(back.means_world, centres)
    in_order = bool((order == np.arange(len(back))).all())
    assert in_order == (agreement >= MIN_AGREEMENT)
    if in_order:
        assert len(document["meshes"]) == 1


def glb_document(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


def test_viewer_glb_of_run_has_its_name_solid_middles_and_a_camera(run, octasplat, tmp_path):
    result = octasplat("export", run.output, tmp_path / "a.viewer.glb", "--extent", "all")
    assert result.exit_code == 0, result.output
    document = glb_document(tmp_path / "a.viewer.glb")
    first = document["meshes"][0]["primitives"]
    assert [document["materials"][each["material"]]["alphaMode"] for each in first] == ["MASK", "BLEND"]
    assert "_GID" not in first[1]["attributes"]
    (node,) = [node for node in document["nodes"] if "camera" in node]
    seen = run_viewpoints(run.output)
    view = {view.name: view for view in seen.views}[node["name"]]
    assert node["translation"] == pytest.approx(view.origin_world.tolist())
    x, y, z, w = node["rotation"]
    looks = -np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert looks == pytest.approx(view.rotation_cam_from_world[2], abs=1e-6)
    # read back, it stands where the scene does, though it is turned upright for viewers
    means = read_scene(tmp_path / "a.viewer.glb")[0].means_world
    distances, _ = cKDTree(read_scene(run.output)[0].means_world).query(means)
    assert len(means) > 100 and distances.max() < 1e-3
    # the run itself wrote the same, of what was photographed
    assert len(read_scene(run.output / "viewer.glb")[0]) <= len(read_scene(tmp_path / "a.viewer.glb")[0])


def test_extent_is_for_viewer_glb(run, octasplat, tmp_path):
    result = octasplat("export", run.output, tmp_path / "a.glb", "--extent", "all")
    assert result.exit_code == 2 and "--extent" in result.output


def test_for_viewers_is_for_octagon_glb(run, octasplat, tmp_path):
    for extra in (("a.ply",), ("a.glb", "--opaque")):
        result = octasplat("export", run.output, tmp_path / extra[0], *extra[1:], "--for-viewers")
        assert result.exit_code == 2 and "--for-viewers" in result.output


def test_unused_color_option_is_warned_of(run, octasplat, tmp_path):
    told = "color goes with formats of one color"
    done = octasplat("export", run.output, tmp_path / "a.spz", "--color", "constant")
    assert done.exit_code == 0 and told in done.stderr
    both = (tmp_path / "b.spz", tmp_path / "b.glb")
    done = octasplat("export", run.output, *both, "--color", "constant", "--threads", 1)
    assert done.exit_code == 0 and told not in done.output, done.output
