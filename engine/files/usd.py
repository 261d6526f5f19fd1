"""Export as USD: a ``ParticleField`` with the Gaussian surflet kernel, by definition a flat Gaussian.

The kernel is exp(-|p|^2 / 2) in the local xy plane and nothing off it, so the normal becomes the local z
axis; the scale along it has no meaning and is the flat 1e-5. The data are turned to y up. Needs the package
usd-core (the extra ``usd``).
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.file_arrays import new_array
from octasplat.engine.core.local_origin import is_set
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.encodings import half_turn_points, half_turn_quats, half_turn_sh, unit_quats
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.splat_rows import check_scales, iterate_blocks, select_for_export
from octasplat.engine.files.usd_stage import ROOT, import_usd, missing_usd, place_in_georeference
from octasplat.engine.files.usdz_surface import MAX_BYTES
from octasplat.engine.gaussians.flattening import rotate_axis_to_first
from octasplat.engine.gaussians.model import FLAT_SCALE, FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

FIELD = f"{ROOT}/gaussians"
COLOR_SPACE = "srgb_rec709_scene"
EXTENT_SIGMAS = 3.0
SCHEMAS = (
    "ParticleFieldPositionAttributeAPI",
    "ParticleFieldOrientationAttributeAPI",
    "ParticleFieldScaleAttributeAPI",
    "ParticleFieldOpacityAttributeAPI",
    "ParticleFieldKernelGaussianSurfletAPI",
    "ParticleFieldSphericalHarmonicsAttributeAPI",
)


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write ``.usda`` (text), ``.usd`` or ``.usdc`` (binary), or ``.usdz`` (a package).

    Raises:
        SceneFileError: usd-core is missing or too old, nothing to write, values that are not finite, or more
            than the 2 GB that a package can hold.
        OSError: the file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    check_scales(scene, path)
    pxr = _import_usd(path)
    suffix = ".usdc" if path.suffix.lower() in (".usdz", ".usd") else path.suffix.lower()
    with partial_folder(path) as folder, atomic_replace(path) as temporary:
        layer = folder / f"scene{suffix}"
        _write_stage(pxr, scene, layer, options.facts)
        if path.suffix.lower() == ".usdz":
            if (size := layer.stat().st_size) > MAX_BYTES:
                raise SceneFileError(
                    f"{path}: not written; {len(scene):,} Gaussians need {size:,} bytes, and a USDZ of ours "
                    f"holds at most {MAX_BYTES:,}. Name a .usdc, or leave faint ones out with min_opacity."
                )
            package = folder / "scene.usdz"
            if not pxr["UsdUtils"].CreateNewUsdzPackage(pxr["Sdf"].AssetPath(str(layer)), str(package)):
                raise SceneFileError(f"{path}: not written; usd-core could not make the package.")
            layer = package
        shutil.copyfile(layer, temporary)
    return (path,)


def _import_usd(path: Path) -> dict[str, ModuleType]:
    pxr = import_usd(path, ("Gf", "Sdf", "Usd", "UsdGeom", "UsdUtils", "UsdVol", "Vt"))
    if not hasattr(pxr["UsdVol"], "ParticleField"):
        raise SceneFileError(f"{path}: this usd-core has no ParticleField; install usd-core 26.5 or later.")
    return pxr


def _packed_orientations(scene: FlatGaussians) -> Float32[np.ndarray, "n 4"]:
    """Return rotations turned to y up, with the normal as the last axis, as usd-core has them in memory."""
    axis_z = np.ones(len(scene), dtype=np.int64)  # the columns of R become r2, r3, r1
    quats = unit_quats(rotate_axis_to_first(half_turn_quats(scene.quats_wxyz), axis_z))
    return np.asarray(quats.astype(np.float32)[:, [1, 2, 3, 0]])  # x, y, z, w


def _three_scales(scene: FlatGaussians) -> Float32[np.ndarray, "n 3"]:
    """Return standard deviations, that along the normal last."""
    return np.concatenate([scene.scales, np.full((len(scene), 1), FLAT_SCALE, np.float32)], axis=1)


def _extent(scene: FlatGaussians) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "3"]]:
    """Return the corners of a box about Gaussians turned to y up."""
    means = half_turn_points(scene.means_world)
    reach = EXTENT_SIGMAS * scene.scales.max(axis=1, keepdims=True)
    return (means - reach).min(axis=0), (means + reach).max(axis=0)


def _in_file(scene: FlatGaussians, folder: Path, make: Callable[[FlatGaussians], np.ndarray]) -> np.ndarray:
    """Return what is made of each block, one after the other, in a file without a name.

    Args:
        scene: not empty.
        folder: for the file.
        make: returns as many rows for each Gaussian.
    """
    first = make(scene.view(slice(0, 1)))
    found = new_array((len(first) * len(scene), *first.shape[1:]), first.dtype, folder)
    end = 0
    for block in iterate_blocks(scene):
        part = make(block)
        found[end : end + len(part)] = part
        end += len(part)
    return found


def _write_stage(pxr: dict[str, ModuleType], scene: FlatGaussians, layer: Path, facts: SceneMetadata) -> None:
    usd, geom, vol, vt = (pxr[name] for name in ("Usd", "UsdGeom", "UsdVol", "Vt"))
    stage = usd.Stage.CreateNew(str(layer))
    geom.SetStageUpAxis(stage, geom.Tokens.y)
    root = geom.Xform.Define(stage, ROOT)
    if facts.georeference is not None:
        place_in_georeference(
            pxr, stage, root, facts.georeference, facts.origin_world, np.diag([1.0, -1.0, -1.0, 1.0])
        )
    else:
        geom.SetStageMetersPerUnit(stage, 1.0)
        if is_set(facts.origin_world):
            x, y, z = facts.origin_world
            # turned to y up, as the data are
            root.AddTranslateOp(geom.XformOp.PrecisionDouble).Set((x, -y, -z))
    stage.SetDefaultPrim(root.GetPrim())
    prim = vol.ParticleField.Define(stage, FIELD).GetPrim()
    for schema in SCHEMAS:
        prim.ApplyAPI(getattr(vol, schema))
    usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)

    def attribute(name: str, values: Any) -> None:
        prim.GetAttribute(name).Set(values)

    def made(make: Callable[[FlatGaussians], np.ndarray]) -> np.ndarray:
        """Return what is made of all blocks; usd-core copies it, so that it need not be in memory as well."""
        return _in_file(scene, layer.parent, make)

    attribute("positions", vt.Vec3fArray.FromNumpy(made(lambda block: half_turn_points(block.means_world))))
    attribute("orientations", vt.QuatfArray.FromNumpy(made(_packed_orientations)))
    attribute("scales", vt.Vec3fArray.FromNumpy(made(_three_scales)))
    attribute("opacities", vt.FloatArray.FromNumpy(made(lambda block: block.opacities)))
    attribute("radiance:sphericalHarmonicsDegree", scene.sh_degree)
    flat_sh = made(lambda block: half_turn_sh(block.sh).reshape(-1, 3))
    attribute("radiance:sphericalHarmonicsCoefficients", vt.Vec3fArray.FromNumpy(flat_sh))
    del flat_sh
    lows, highs = zip(*map(_extent, iterate_blocks(scene)), strict=True)
    extent = np.stack([np.min(lows, axis=0), np.max(highs, axis=0)])
    attribute("extent", vt.Vec3fArray.FromNumpy(extent.astype(np.float32)))
    # For programs that know no particle fields, and show colored points
    fallback = geom.Gprim(prim)
    colors = made(lambda block: srgb_to_linear(np.clip(block.base_rgb_srgb, 0.0, 1.0)))
    fallback.CreateDisplayColorPrimvar(geom.Tokens.vertex).Set(vt.Vec3fArray.FromNumpy(colors))
    opacities = vt.FloatArray.FromNumpy(made(lambda block: block.opacities))
    fallback.CreateDisplayOpacityPrimvar(geom.Tokens.vertex).Set(opacities)
    primvars, kinds = geom.PrimvarsAPI(prim), pxr["Sdf"].ValueTypeNames
    for name, values in scene.channels.items():
        primvar = primvars.CreatePrimvar(name, kinds.FloatArray, geom.Tokens.vertex, values.shape[1])
        primvar.Set(vt.FloatArray.FromNumpy(np.ascontiguousarray(values).reshape(-1)))
    prim.GetAttribute("primvars:displayColor").SetColorSpace("lin_rec709_scene")
    stage.GetRootLayer().Save()


register(
    Exporter(
        "usd",
        ("*.usdz", "*.usdc", "*.usda", "*.usd"),
        "USD ParticleField with the surflet kernel; needs usd-core",
        write,
        missing_usd,
        holds_channels=True,
        holds_harmonics=True,
        holds_origin=True,
    )
)
