"""PLY files made by the rules of other programs; each holds one disc whose normal and axes are known."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import PlyWriteElement, write_ply
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians

FIRST = np.array([0.6, 0.8, 0.0])
SECOND = np.array([-0.48, 0.36, 0.8])
NORMAL = np.cross(FIRST, SECOND)
SIGMAS = (0.3, 0.05)
"""Standard deviations along FIRST and SECOND."""
OPACITY = 0.75


def write_disc(path: Path, axes: list[np.ndarray], scales: list[float], **more: float) -> Path:
    """Write a PLY whose rotation has these columns; its quaternion is not of unit length, as in training."""
    matrix = np.stack(axes, axis=1)[None]
    assert np.linalg.det(matrix[0]) == pytest.approx(1.0)
    rotation = 1.7 * quaternions_from_matrices(matrix)[0]
    rest = {f"f_rest_{k}": 0.01 * k for k in range(int(more.pop("rest", 0)))}
    row = {"x": 1.0, "y": 2.0, "z": 3.0, "nx": 0.0, "ny": 0.0, "nz": 0.0}
    row |= {"f_dc_0": 0.1, "f_dc_1": 0.2, "f_dc_2": 0.3, **rest, "opacity": np.log(OPACITY / (1 - OPACITY))}
    row |= {f"scale_{k}": np.log(scale) for k, scale in enumerate(scales)}
    row |= {f"rot_{k}": value for k, value in enumerate(rotation)} | more
    table = np.array([tuple(row.values())], dtype=[(name, "<f4") for name in row])
    write_ply(path, [PlyWriteElement("vertex", 1, table.dtype, [table])])
    return path


def assert_is_the_disc(scene: FlatGaussians, sigmas: tuple[float, float] = SIGMAS) -> None:
    axes = scene.rotations[0].astype(np.float64)
    assert abs(axes[:, 0] @ NORMAL) == pytest.approx(1.0, abs=1e-5)
    legs = axes[:, 1:] * scene.scales[0]
    expected = np.stack([FIRST * sigmas[0], SECOND * sigmas[1]], axis=1)
    np.testing.assert_allclose(legs @ legs.T, expected @ expected.T, atol=1e-6)


DIALECTS = {
    # 2DGS: two scales, in the plane of the first two columns; the third is the normal.
    "2dgs": ([FIRST, SECOND, NORMAL], [*SIGMAS], None),
    # gsplat's 2DGS: likewise, and a third scale that nothing uses, here the largest.
    "gsplat": ([FIRST, SECOND, NORMAL], [*SIGMAS, 0.9], "2dgs"),
    # GaMeS: two scales, of the last two columns; the first is the normal.
    "games": ([NORMAL, FIRST, SECOND], [*SIGMAS], "games"),
    # PGSR: three scales, any of which may be the smallest; its axis is the normal.
    "pgsr": ([SECOND, NORMAL, FIRST], [SIGMAS[1], 1e-5, SIGMAS[0]], None),
    # SuGaR bound to a mesh: three scales, the first a thickness that all share.
    "sugar": ([NORMAL, FIRST, SECOND], [1e-6, *SIGMAS], None),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_ply_dialect_discs_match_source_program(dialect: str, tmp_path: Path) -> None:
    axes, scales, name = DIALECTS[dialect]
    scene, report = read_scene(write_disc(tmp_path / "a.ply", axes, scales), name)
    assert_is_the_disc(scene)
    assert report.thick == 0
    assert scene.opacities[0] == pytest.approx(OPACITY)


def test_gaussian_opacity_fields_filter_is_applied(tmp_path: Path) -> None:
    filter_3d = 0.04
    path = write_disc(tmp_path / "a.ply", [FIRST, SECOND, NORMAL], [*SIGMAS, 0.03], filter_3D=filter_3d)
    scene, report = read_scene(path, channels="all")
    wider = [float(np.hypot(sigma, filter_3d)) for sigma in (*SIGMAS, 0.03)]
    assert_is_the_disc(scene, (wider[0], wider[1]))
    kept = np.prod([*SIGMAS, 0.03]) / np.prod(wider)  # the integral over space stays the same
    assert scene.opacities[0] == pytest.approx(OPACITY * kept, rel=1e-5)
    assert any("filter_3D" in note for note in report.notes)
    assert scene.channels.widths == {}


def test_ply_zero_filter_leaves_scales_unchanged(tmp_path: Path) -> None:
    path = write_disc(tmp_path / "a.ply", [NORMAL, FIRST, SECOND], [1e-5, *SIGMAS], filter_3D=0.0)
    scene, _ = read_scene(path)
    assert_is_the_disc(scene)
    assert scene.opacities[0] == pytest.approx(OPACITY)


def test_ply_degree_four_harmonics_are_truncated_with_warning(tmp_path: Path) -> None:
    path = write_disc(tmp_path / "a.ply", [NORMAL, FIRST, SECOND], [1e-5, *SIGMAS], rest=72)
    scene, report = read_scene(path)
    expected = 0.01 * np.array([[24 * color + k for color in range(3)] for k in range(15)])
    np.testing.assert_allclose(scene.sh[0, 1:], expected, rtol=1e-6)
    assert report.notes == ("Harmonics of degree 4 were left out; degree 3 is the highest here.",)


def test_invalid_harmonics_count_is_refused(tmp_path: Path) -> None:
    path = write_disc(tmp_path / "a.ply", [NORMAL, FIRST, SECOND], [1e-5, *SIGMAS], rest=30)
    with pytest.raises(SceneFileError, match="30 f_rest"):
        read_scene(path)


def write_rows(path: Path, log_scales: np.ndarray, **more: np.ndarray) -> Path:
    """Write a PLY of Gaussians with these scales and everything else alike."""
    count = len(log_scales)
    random = np.random.default_rng(11)
    row = {name: random.standard_normal(count) for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")}
    row |= {"opacity": np.ones(count)} | {f"scale_{k}": log_scales[:, k] for k in range(3)}
    row |= {f"rot_{k}": random.standard_normal(count) for k in range(4)} | more
    table = np.empty(count, dtype=[(name, "<f4") for name in row])
    for name, values in row.items():
        table[name] = values
    write_ply(path, [PlyWriteElement("vertex", count, table.dtype, [table])])
    return path


def split_and_cloned(count: int) -> np.ndarray:
    """Third scales of gsplat's 2DGS: those of few first points, copied, and divided by 1.6 where split."""
    random = np.random.default_rng(12)
    first = random.uniform(-4, -2, count // 4)
    return random.choice(first, count) - np.log(1.6) * random.integers(0, 2, count)


def test_2dgs_of_gsplat_is_known_by_its_untrained_third_scale(tmp_path: Path) -> None:
    scales = np.random.default_rng(1).uniform(-5, -1, (1000, 3))
    scales[:, 2] = split_and_cloned(1000)
    path = write_rows(tmp_path / "a.ply", scales)
    scene, report = read_scene(path)
    named, _ = read_scene(path, "2dgs")
    np.testing.assert_array_equal(scene.quats_wxyz, named.quats_wxyz)
    np.testing.assert_array_equal(scene.log_scales, scales[:, :2].astype(np.float32))
    assert any("gsplat's 2DGS" in note for note in report.notes)


@pytest.mark.parametrize("kind", ["3dgs", "one thickness", "few bits", "few Gaussians"])
def test_3dgs_scales_are_not_taken_for_2dgs_of_gsplat(tmp_path: Path, kind: str) -> None:
    scales = np.random.default_rng(1).uniform(-5, -1, (1000, 3))
    if kind == "one thickness":
        scales[:, 2] = np.log(1e-6)
    elif kind == "few bits":
        scales = np.rint(scales * 16) / 16
    elif kind == "few Gaussians":
        scales = scales[:100]
        scales[:, 2] = split_and_cloned(100)
    scene, report = read_scene(write_rows(tmp_path / "a.ply", scales))
    assert not any("gsplat" in note for note in report.notes)
    np.testing.assert_allclose(np.sort(scene.log_scales), np.sort(scales)[:, 1:], atol=1e-6)


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (
            ("trbf_center", "trbf_scale", "motion_0", "motion_1"),
            "trbf_center, trbf_scale, motion mean nothing",
        ),
        (("beta",), "properties beta mean nothing"),
        (("scale_t", "rot_r_0", "rot_r_1"), "properties scale_t, rot_r mean nothing"),
        (tuple(f"ins_feat_{k}" for k in range(16)), "properties ins_feat mean nothing"),
        (("albedo_0", "albedo_1", "albedo_2", "roughness", "metallic"), "albedo, roughness, metallic mean"),
    ],
)
def test_properties_of_other_programs_are_named_when_left_out(
    tmp_path: Path, names: tuple[str, ...], told: str
) -> None:
    scales = np.random.default_rng(1).uniform(-5, -1, (20, 3))
    path = write_rows(tmp_path / "a.ply", scales, **{name: np.full(20, 0.5) for name in names})
    assert told in " ".join(read_scene(path)[1].notes)
    kept, report = read_scene(path, channels="all")
    assert kept.channels and not any("mean nothing" in note for note in report.notes)


@pytest.mark.parametrize("name", ["f_anchor_feat_0", "f_offset_0"])
def test_anchors_of_scaffold_gs_are_refused_by_name(tmp_path: Path, name: str) -> None:
    scales = np.zeros((5, 3))
    path = write_rows(tmp_path / "a.ply", scales, **{name: np.zeros(5)})
    with pytest.raises(SceneFileError, match="anchors of Scaffold-GS"):
        read_scene(path)
