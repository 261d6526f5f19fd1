from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import export_scene
from octasplat.engine.files import usd as usd_format
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis

usd = pytest.importorskip(
    "pxr.Usd", reason="usd-core is not installed (pip install -c constraints.txt -e '.[usd]')"
)
Make = Callable[..., FlatGaussians]
HALF_TURN = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize("name", ["a.usda", "a.usdc", "a.usd", "a.usdz"])
def test_usd_surflets_equal_gaussians(make_scene: Make, tmp_path: Path, name: str) -> None:
    from pxr import Gf, UsdGeom

    scene = make_scene(50)
    assert export_scene(scene, tmp_path / name) == (tmp_path / name,)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    stage = usd.Stage.Open(str(tmp_path / name))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    (prim,) = (prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField")
    assert stage.GetDefaultPrim().GetPath() == prim.GetPath().GetParentPath()
    assert "ParticleFieldKernelGaussianSurfletAPI" in prim.GetAppliedSchemas()
    assert prim.GetAttribute("colorSpace:name").Get() == "srgb_rec709_scene"

    def values(attribute: str) -> np.ndarray:
        return np.array(prim.GetAttribute(attribute).Get())

    np.testing.assert_array_equal(values("positions"), scene.means_world * np.float32([1, -1, -1]))
    np.testing.assert_array_equal(values("opacities"), scene.opacities)
    scales = values("scales")
    np.testing.assert_array_equal(scales[:, :2], scene.scales)
    # The kernel lies in the local xy plane: its legs must span what our octagons span.
    for number, quat in enumerate(prim.GetAttribute("orientations").Get()):
        assert quat.GetLength() == pytest.approx(1.0, abs=1e-6)
        matrix = np.array(Gf.Matrix3d(Gf.Quatd(quat))).T  # row vectors there, columns here
        legs = matrix[:, :2] * scales[number, :2]
        ours = HALF_TURN @ scene.rotations[number][:, 1:] * scene.scales[number]
        np.testing.assert_allclose(legs @ legs.T, ours @ ours.T, atol=1e-5)
    assert values("radiance:sphericalHarmonicsDegree") == 1
    sh = values("radiance:sphericalHarmonicsCoefficients").reshape(50, 4, 3)
    direction = np.array([[0.48, -0.6, 0.64]])
    np.testing.assert_allclose(
        np.einsum("mk,nkc->nc", sh_basis(direction @ HALF_TURN, 1), sh),
        np.einsum("mk,nkc->nc", sh_basis(direction, 1), scene.sh),
        atol=1e-5,
    )
    low, high = values("extent")
    assert (low < values("positions").min(axis=0)).all() and (high > values("positions").max(axis=0)).all()


def test_package_beyond_what_usd_reads_is_refused(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(usd_format, "MAX_BYTES", 1000)
    with pytest.raises(SceneFileError, match=r"50 Gaussians need .* bytes, and a USDZ .* at most 1,000"):
        export_scene(make_scene(50), tmp_path / "a.usdz")
    assert list(tmp_path.iterdir()) == []
    export_scene(make_scene(50), tmp_path / "a.usdc")


@pytest.mark.parametrize("name", ["a.usdc", "a.usdz"])
def test_usd_file_passes_compliance_check(make_scene: Make, tmp_path: Path, name: str) -> None:
    from pxr import UsdValidation

    export_scene(make_scene(20), tmp_path / name)
    registry = UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert len(validators) >= 20
    context = UsdValidation.ValidationContext(validators)
    stage = usd.Stage.Open(str(tmp_path / name))
    errors = [f"{error.GetName()}: {error.GetMessage()}" for error in context.Validate(stage)]
    assert errors == []


def test_usd_missing_dependency_is_named(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(SceneFileError, match=r"a\.usdz: needs the package usd-core; .*pip install 'usd-core"):
        export_scene(make_scene(3), tmp_path / "a.usdz")
    assert list(tmp_path.iterdir()) == []


def test_usd_channels_are_primvars(make_scene: Make, tmp_path: Path) -> None:
    from pxr import UsdGeom

    albedo, label = np.random.default_rng(0).random((20, 3), np.float32), np.arange(20, dtype=np.float32)
    scene = make_scene(20).with_channels({"albedo": albedo, "label": label[:, None]})
    export_scene(scene, tmp_path / "a.usda")
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/octasplat/gaussians"))
    for name, array in (("albedo", albedo), ("label", label[:, None])):
        primvar = primvars.GetPrimvar(name)
        assert (primvar.GetInterpolation(), primvar.GetElementSize()) == ("vertex", array.shape[1])
        np.testing.assert_array_equal(np.array(primvar.Get()).reshape(array.shape), array)
