"""``octasplat import``, and other commands on files of any splat format."""

import numpy as np
import pytest

from octasplat.engine.core.ply_container import PlyWriteElement, write_ply
from octasplat.engine.files import read_scene
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians


@pytest.fixture
def flat() -> FlatGaussians:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    return FlatGaussians(normal(60, 3), normal(60, 4), normal(60, 2) * 0.3 - 2, normal(60), normal(60, 9, 3))


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz", "a.splats.glb"])
def test_import_exported_scene_round_trips(octasplat, flat, tmp_path, name):
    write_gaussian_ply(flat, tmp_path / "own.ply")
    assert octasplat("export", tmp_path / "own.ply", tmp_path / name).exit_code == 0
    result = octasplat("import", tmp_path / name, tmp_path / "back.ply")
    assert result.exit_code == 0, result.output
    assert "60 Gaussians with spherical harmonics of degree" in result.stdout
    assert f"Wrote {tmp_path / 'back.ply'}" in result.stdout
    back, _ = read_gaussian_ply(tmp_path / "back.ply")
    np.testing.assert_allclose(back.means_world, flat.means_world, atol=2e-4)
    np.testing.assert_allclose(back.opacities, flat.opacities, atol=0.003)


def test_import_reports_flattening_loss(octasplat, tmp_path):
    write_thick(tmp_path / "thick.ply", [0.1, 0.2, 0.2, 0.9])
    result = octasplat("import", tmp_path / "thick.ply", tmp_path / "flat.ply")
    assert result.exit_code == 0, result.output
    assert "4 of 4 Gaussians were not flat" in result.stderr and "Warning" not in result.stderr
    assert "0.200 in the median, 0.900 at most, above one half in 1 (25.0%)" in result.stdout
    again = octasplat("import", tmp_path / "flat.ply", tmp_path / "again.ply")
    assert "All of them were flat already." in again.stdout and again.stderr == ""
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "flat.ply").read_bytes()
    write_thick(tmp_path / "thick.ply", [0.1, 0.8, 0.9])
    quiet = octasplat("import", tmp_path / "thick.ply", tmp_path / "flat.ply", "--quiet")
    assert quiet.stdout == "" and quiet.stderr.startswith("Warning: ")


def test_import_drop_invalid_removes_gaussians(octasplat, flat, tmp_path):
    write_gaussian_ply(flat, tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    rows = np.frombuffer(data, "<f4", offset=data.index(b"end_header\n") + 11).reshape(60, -1)
    rows[5, 0] = np.inf
    (tmp_path / "a.ply").write_bytes(data)
    result = octasplat("import", tmp_path / "a.ply", tmp_path / "b.ply")
    assert result.exit_code == 1 and result.stderr.count("\n") == 1
    assert "a.ply" in result.stderr and "--drop-invalid" in result.stderr
    assert not (tmp_path / "b.ply").exists()
    result = octasplat("import", tmp_path / "a.ply", tmp_path / "b.ply", "--drop-invalid")
    assert result.exit_code == 0 and "Left out: 1." in result.stdout
    assert len(read_scene(tmp_path / "b.ply")[0]) == 59


def test_harmonics_can_be_cut(octasplat, flat, tmp_path):
    write_gaussian_ply(flat, tmp_path / "a.ply")
    assert octasplat("import", tmp_path / "a.ply", tmp_path / "b.ply", "--sh-degree", 1).exit_code == 0
    back, _ = read_gaussian_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(back.sh, flat.sh[:, :4])


def test_import_unsupported_names_are_refused(octasplat, flat, tmp_path):
    write_gaussian_ply(flat, tmp_path / "a.ply")
    result = octasplat("import", tmp_path / "a.ply", tmp_path / "b.glb")
    assert result.exit_code == 2 and "octasplat export writes the other formats" in result.stderr
    result = octasplat("import", tmp_path / "a.ply", tmp_path / "b.ply", "--format", "spz")
    assert result.exit_code == 1 and "a.ply: is no SPZ file" in result.stderr
    (tmp_path / "a.xyz").write_text("hello")
    result = octasplat("import", tmp_path / "a.xyz", tmp_path / "b.ply")
    assert result.exit_code == 1 and "the formats are" in result.stderr


def test_splat_renders_and_run_exports(octasplat, flat, run, tmp_path):
    write_gaussian_ply(flat, tmp_path / "own.ply")
    assert octasplat("export", tmp_path / "own.ply", tmp_path / "a.spz", "--spz-version", 4).exit_code == 0
    assert (tmp_path / "a.spz").read_bytes()[:4] == b"NGSP"
    size = ("--frames", 1, "--width", 32, "--height", 24, "--threads", 1)
    result = octasplat("render", tmp_path / "a.spz", "-o", tmp_path / "frames", "--turntable", *size)
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "frames").iterdir())) == 1
    result = octasplat("export", run.output, tmp_path / "run.splat")
    assert result.exit_code == 0, result.output
    assert len(read_scene(tmp_path / "run.splat")[0]) == len(read_scene(run.output)[0])


def write_thick(path, thicknesses):
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    rows = np.zeros(len(thicknesses), dtype=[(name, "<f4") for name in names])
    rows["x"] = np.arange(len(rows))
    rows["scale_0"] = np.log(thicknesses)
    rows["rot_0"] = 1
    write_ply(path, [PlyWriteElement("vertex", len(rows), rows.dtype, iter([rows]))])


def test_import_channels_option_keeps_extra_properties(octasplat, flat, tmp_path):
    label = np.arange(60, dtype=np.float32)[:, None]
    write_gaussian_ply(flat.with_channels({"label": label, "albedo": np.tile(label, 3)}), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"comment octasplat_", b"comment elsewhere_"))
    for wanted, widths in (
        ("", {}), ("all", {"label": 1, "albedo": 3}), ("albedo, label", {"albedo": 3, "label": 1})
    ):  # fmt: skip
        arguments = ["--channels", wanted] if wanted else []
        result = octasplat("import", *arguments, tmp_path / "a.ply", tmp_path / "b.ply")
        assert result.exit_code == 0, result.output
        assert ("Channels: " + ", ".join(widths) in result.stdout) == bool(widths)
        back, _ = read_gaussian_ply(tmp_path / "b.ply")
        assert back.channels.widths == widths
        if widths:
            np.testing.assert_array_equal(back.channels["label"], label)
    refused = octasplat("import", "--channels", "roughness", tmp_path / "a.ply", tmp_path / "c.ply")
    assert refused.exit_code == 1 and "has no channel 'roughness'; it has label, albedo." in refused.stderr
    octasplat("export", tmp_path / "b.ply", tmp_path / "a.spz")
    none = octasplat("import", "--channels", "label", tmp_path / "a.spz", tmp_path / "c.ply")
    assert none.exit_code == 1 and "the format spz has no place for channels" in none.stderr
