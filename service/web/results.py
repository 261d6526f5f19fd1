"""Results page of a finished job: metrics, views, downloads and the programs that open them."""

import json
import logging
import math
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePosixPath
from typing import Any, cast

from octasplat.engine.render.file_names import unique_render_names
from octasplat.engine.runs.result_files import OCTAGONS_PLY, RESULT_FILES
from octasplat.workers.db.rows import Artifact, DatasetFile
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.protocol import Storage

logger = logging.getLogger(__name__)

MAX_JSON_BYTES = 16 << 20
VIEWS = "views.json"
SCENE, METRICS, REPORT, CONFIG, HELD_OUT, TRAINING = (
    "scene.ply", "metrics.json", "report.html", "config.json", "held_out.json", "training.json",
)  # fmt: skip
LAYERS: Mapping[str, str] = {
    "normal": "Normals",
    "depth": "Depth",
    "albedo": "Base color",
    "metallic": "Metallic",
    "roughness": "Roughness",
    "visibility": "Visibility",
    "indirect": "Indirect light",
}
"""What can be shown of a view with materials, in the order in which it is offered."""
LEARNT_LIGHT = "layers/environment.png"
_BROWSER_IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp"})


@dataclass(frozen=True)
class Metric:
    """A metric: its key in ``metrics.json``, and its display."""

    key: str
    heading: str
    decimals: int
    unit: str
    help: str
    higher_is_better: bool = True


METRICS_SHOWN = (
    Metric("psnr", "PSNR", 2, "dB", "Peak signal-to-noise ratio; higher is better"),
    Metric("ssim", "SSIM", 4, "", "Structural similarity, as 3DGS computes it; higher is better"),
    Metric("ms_ssim", "MS-SSIM", 4, "", "Structural similarity at several scales; higher is better"),
    Metric("flip", "FLIP", 4, "", "Perceived difference; lower is better", higher_is_better=False),
)


@dataclass(frozen=True)
class HeldOutView:
    """A held-out view: its metrics, its render and its photograph.

    Attributes:
        name: of the photograph.
        values: by the key of the metric; None where it could not be measured.
        render: name of the result that shows it, if there is one.
        photograph: name in the dataset, if a browser can show it.
        layers: names of the results that show what lies behind the render, by layer.
        width: of the render, px.
        height: of the render, px.
    """

    name: str
    values: Mapping[str, float | None]
    render: str | None
    photograph: str | None
    layers: Mapping[str, str]
    width: int
    height: int


@dataclass(frozen=True)
class Measurements:
    """Metrics read from ``metrics.json``."""

    columns: tuple[Metric, ...]
    mean: Mapping[str, float | None]
    interval: tuple[float, float] | None
    gaussians: int | None
    seconds: float | None
    views: tuple[HeldOutView, ...]


@dataclass(frozen=True)
class Download:
    """A result to save, and the programs that open it."""

    name: str
    size_bytes: int
    opens_in: str


@dataclass(frozen=True)
class DownloadGroup:
    """A group of downloads; a folded group opens on request."""

    title: str
    files: list[Download]
    folded: bool

    @property
    def size_bytes(self) -> int:
        """Return the total length of the downloads."""
        return sum(file.size_bytes for file in self.files)


def read_json(storage: Storage, row: Artifact | None) -> dict[str, Any]:
    """Return the content of a small JSON result; empty if it cannot be read."""
    content = _read_json(storage, row)
    return content if isinstance(content, dict) else {}


def read_names(storage: Storage, row: Artifact | None) -> list[str]:
    """Return the names in a small JSON result; none if it cannot be read."""
    content = _read_json(storage, row)
    return [str(name) for name in content] if isinstance(content, list) else []


def read_json_content(storage: Storage, sha256: str) -> dict[str, Any]:
    """Return a small JSON content that is soon replaced, and so not cached; empty if it cannot be read."""
    try:
        if storage.stat(sha256).size_bytes > MAX_JSON_BYTES:
            return {}
        content = json.loads(b"".join(storage.read(sha256)))
    except (StorageError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _read_json(storage: Storage, row: Artifact | None) -> object:
    if row is None or row.size_bytes > MAX_JSON_BYTES:
        return None
    try:
        text = _read_text(cast(Hashable, storage), row.sha256)
    except StorageError as error:
        logger.info("%s of job %s cannot be shown: %s", row.name, row.job_id, error)
        return None
    try:
        return json.loads(text)
    except ValueError:
        return None


@lru_cache(maxsize=256)
def _read_text(storage: Hashable, sha256: str) -> bytes:
    """Return stored text, cached, as content never changes under its digest."""
    return b"".join(cast(Storage, storage).read(sha256))


def read_measurements(
    metrics: Mapping[str, Any], artifacts: Sequence[Artifact], photographs: Sequence[DatasetFile]
) -> Measurements | None:
    """Return the metrics of a result, worst view first; None if there are none."""
    mean = _as_mapping(metrics.get("mean"))
    rows = {str(name): _as_mapping(row) for name, row in _as_mapping(metrics.get("views")).items()}
    if not mean:
        return None
    results = {row.name for row in artifacts}
    files = {file.path for file in photographs}
    views = []
    for name, row in rows.items():
        (rendered,) = unique_render_names([name])
        # Photographs that were trained on are not listed, and one may differ by its suffix alone.
        names = (f"renders/{rendered}.png", f"renders/{name}.png")
        render = next((found for found in names if found in results), names[0])
        photograph = f"images/{name}"
        has_photograph = photograph in files and PurePosixPath(name).suffix.lower() in _BROWSER_IMAGE_SUFFIXES
        views.append(
            HeldOutView(
                name=name,
                values={metric.key: _finite_number(row.get(metric.key)) for metric in METRICS_SHOWN},
                render=render if render in results else None,
                photograph=photograph if has_photograph else None,
                layers={
                    layer: name
                    for layer in LAYERS
                    if (name := render.replace("renders/", f"layers/{layer}/", 1)) in results
                },
                # The usual shape of a photograph where the size is not known.
                width=int(_finite_number(row.get("width")) or 4),
                height=int(_finite_number(row.get("height")) or 3),
            )
        )
    views.sort(key=lambda view: (_value_or(view.values["psnr"], math.inf), view.name))
    interval = metrics.get("mean_psnr_ci95")
    bounds = [_finite_number(bound) for bound in interval] if isinstance(interval, list) else []
    low, high = bounds if len(bounds) == 2 else (None, None)
    gaussians = _finite_number(metrics.get("gaussians"))
    return Measurements(
        columns=tuple(metric for metric in METRICS_SHOWN if _finite_number(mean.get(metric.key)) is not None),
        mean={metric.key: _finite_number(mean.get(metric.key)) for metric in METRICS_SHOWN},
        interval=(low, high) if low is not None and high is not None else None,
        gaussians=None if gaussians is None else int(gaussians),
        seconds=_finite_number(metrics.get("seconds")),
        views=tuple(views),
    )


def mean_psnr(metrics: Mapping[str, Any]) -> float | None:
    """Return the mean PSNR of the held-out views, dB."""
    return _finite_number(_as_mapping(metrics.get("mean")).get("psnr"))


def viewable_mesh(artifacts: Sequence[Artifact]) -> Artifact | None:
    """Return the result that is a mesh which the page can show; None if there is none."""
    meshes = [row for row in artifacts if row.name.lower().endswith(".glb") and not _holds_splats(row.name)]
    return min(meshes, key=lambda row: (_sort_rank(row.name), row.name), default=None)


def download_groups(artifacts: Sequence[Artifact]) -> list[DownloadGroup]:
    """Return the results grouped by their use."""
    groups = {title: DownloadGroup(title, [], folded) for title, folded in _GROUPS.items()}
    for row in sorted(artifacts, key=lambda row: (_sort_rank(row.name), row.name)):
        group, opens_in = _group_and_use(row.name)
        groups[group].files.append(Download(row.name, row.size_bytes, opens_in))
    return [group for group in groups.values() if group.files]


_SCENE, _FIGURES, _IMAGES, _RECORDS = "Scene and meshes", "Report and figures", "Images", "Records of the run"
_PARTS = "Parts of levels of detail"
_GROUPS = {_SCENE: False, _FIGURES: False, _IMAGES: True, _PARTS: True, _RECORDS: True}
_USE_BY_NAME = {
    SCENE: (_SCENE, "SuperSplat, PlayCanvas, Spark, Unity and Unreal splat plug-ins; octasplat itself"),
    **{name: (_SCENE, file.opens_in) for file in RESULT_FILES for name in file.names},
    "octagons_alpha.png": (_SCENE, "the texture that octagons.obj uses"),
    "mesh_alpha.png": (_SCENE, "the texture that mesh.obj uses"),
    "surface.usdz": (
        _SCENE,
        "iPhone and iPad (AR Quick Look), Blender, USD viewers: one mesh of opaque triangles",
    ),
    "lod-meta.json": (_SCENE, "the PlayCanvas engine, with the folders of its chunks"),
    "tileset.json": (_SCENE, "CesiumJS, with the folder of its tiles"),
    METRICS: (_FIGURES, "any program that reads JSON"),
    REPORT: (_FIGURES, "a browser; one file, to keep or to send"),
    CONFIG: (_RECORDS, "a text editor: every setting of the run"),
    HELD_OUT: (_RECORDS, "a text editor: the photographs that training never saw"),
    "environment.hdr": (_SCENE, "Blender and whatever takes HDR light: what lit the photographs, all around"),
    "environment.exr": (_SCENE, "the same light as it was learnt, to the last digit; octasplat itself"),
    "background.exr": (_SCENE, "Blender and whatever takes EXR maps: the sky, and what else is far away"),
    "residual.npz": (
        _RECORDS,
        "octasplat itself: what materials and light do not explain of the photographs, by direction",
    ),
    "edits.json": (_RECORDS, "a text editor: what was changed since the training"),
    "views.json": (_RECORDS, "octasplat render and surface, which need no photographs then"),
    "georeference.json": (_RECORDS, "a text editor: where the scene lies, how large it is, and what is up"),
    "events.jsonl": (_RECORDS, "a text editor: what happened when, a line each"),
    "training.json": (_RECORDS, "a text editor"),
    "plan.json": (_RECORDS, "a text editor: what the time for the training was used for"),
}
_USE_BY_SUFFIX = {
    ".glb": (
        _SCENE,
        "Blender, three.js, model-viewer, any glTF viewer",
    ),
    ".obj": (_SCENE, "Blender, MeshLab, most 3D programs: geometry and colors, without opacity"),
    ".mtl": (_SCENE, "goes with the OBJ of that name"),
    ".spz": (_SCENE, "Niantic Scaniverse, Spark, PlayCanvas: small, for the web"),
    ".sog": (_SCENE, "PlayCanvas and SuperSplat: the smallest, for the web"),
    ".splat": (_SCENE, "web viewers such as antimatter15/splat"),
    ".usdz": (_SCENE, "OpenUSD 26 and later, as a particle field"),
    ".usdc": (_SCENE, "OpenUSD 26 and later, as a particle field"),
    ".usda": (_SCENE, "OpenUSD 26 and later, as a particle field"),
    ".usd": (_SCENE, "OpenUSD 26 and later, as a particle field"),
    ".ply": (_SCENE, "splat viewers, if it holds Gaussians; Blender and MeshLab, if it holds a mesh"),
    ".stl": (_SCENE, "Blender, MeshLab, 3D printing"),
    ".mp4": (_FIGURES, "any video player or browser"),
    ".png": (_IMAGES, "any image viewer"),
    ".exr": (_IMAGES, "Blender, Nuke, DJV: linear color, depth and normals"),
    ".bin": (_RECORDS, "COLMAP"),
    ".txt": (_RECORDS, "COLMAP or a text editor"),
}
_TILE = re.compile(r"tiles/\d+_\d+\.glb")
_CHUNK_FILE = re.compile(r"\d+_\d+/[^/]+")
_USE_OTHER = (_RECORDS, "a text editor")


def _group_and_use(name: str) -> tuple[str, str]:
    lower = name.lower()
    if name in _USE_BY_NAME:
        return _USE_BY_NAME[name]
    # Before the suffix, which meshes have too.
    if _TILE.fullmatch(name):
        return _PARTS, "goes with tileset.json, in the folder of its name"
    if _CHUNK_FILE.fullmatch(name):
        return _PARTS, "goes with lod-meta.json, in the folder of its name"
    if _holds_splats(name):
        return _SCENE, "three.js, PlayCanvas, Babylon.js: Gaussians by KHR_gaussian_splatting"
    if lower.endswith(("mesh.ply", OCTAGONS_PLY.name)):
        return _SCENE, OCTAGONS_PLY.opens_in
    return _USE_BY_SUFFIX.get(PurePosixPath(lower).suffix, _USE_OTHER)


def _holds_splats(name: str) -> bool:
    is_named_so = name.lower().endswith((".splats.glb", "_splats.glb", "-splats.glb"))
    return is_named_so or _TILE.fullmatch(name) is not None


def _sort_rank(name: str) -> int:
    order = [SCENE, *(name for file in RESULT_FILES for name in file.names), REPORT, METRICS]
    return order.index(name) if name in order else len(order)


def _as_mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _finite_number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _value_or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
