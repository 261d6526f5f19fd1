"""SOG files made by hand, with PNG in place of WebP, which the format allows; real ones are WebP."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import importer_for, read_scene
from octasplat.engine.files.gaussian_ply import read_ply_cloud
from octasplat.engine.gaussians.flattening import GaussianCloud
from tests.support.cloud_difference import difference

Make = Callable[..., GaussianCloud]
COUNT, WIDTH = 200, 16
PALETTE = 128


def write_png(path: Path, pixels: np.ndarray) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.UINT8)
    spec["oiio:UnassociatedAlpha"] = 1
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(np.ascontiguousarray(pixels)) and out.close()


def image(values: np.ndarray) -> np.ndarray:
    """One pixel a Gaussian, row after row, with unused pixels at the end."""
    rows = -(-len(values) // WIDTH) + 1
    pixels = np.full((rows * WIDTH, values.shape[1]), 77, np.uint8)
    pixels[: len(values)] = values
    return pixels.reshape(rows, WIDTH, -1)


def nearest(book: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.abs(values[..., None] - book).argmin(axis=-1)


def steps(values: np.ndarray, low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    return np.rint((values - low) / (high - low) * count).astype(int)


def write_sog(
    folder: Path, cloud: GaussianCloud, version: int, labels: np.ndarray | None = None
) -> dict[str, Any]:
    """Write the images and meta.json; harmonics are those of the first ``PALETTE`` Gaussians, by label."""
    folder.mkdir(parents=True, exist_ok=True)
    meta: dict[str, Any] = {"version": 2, "count": COUNT} if version == 2 else {}

    def put(name: str, values: np.ndarray) -> str:
        write_png(folder / f"{name}.png", values if values.ndim == 3 else image(values))
        return f"{name}.png"

    curved = np.sign(cloud.means_world) * np.log1p(np.abs(cloud.means_world))
    low, high = curved.min(axis=0), curved.max(axis=0)
    words = steps(curved, low, high, 65535)
    meta["means"] = {
        "shape": [COUNT, 3], "mins": low.tolist(), "maxs": high.tolist(),
        "files": [put("means_l", words & 255), put("means_u", words >> 8)],
    }  # fmt: skip
    quats = np.empty((COUNT, 4), np.uint8)
    for i, q in enumerate(cloud.quats_wxyz):
        largest = int(np.argmax(np.abs(q)))
        q = q if q[largest] > 0 else -q
        quats[i] = [*np.rint((np.delete(q, largest) * np.sqrt(2) + 1) * 127.5), 252 + largest]
    meta["quats"] = {"shape": [COUNT, 4], "files": [put("quats", quats)]}
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits))
    dc = cloud.sh[:, 0]
    if version == 2:
        book = np.linspace(-6, -1, 256)
        meta["scales"] = {
            "codebook": book.tolist(),
            "files": [put("scales", nearest(book, cloud.log_scales))],
        }
        book = np.linspace(dc.min(), dc.max(), 256)
        sh0 = np.column_stack([nearest(book, dc), np.rint(opacity * 255)])
        meta["sh0"] = {"codebook": book.tolist(), "files": [put("sh0", sh0)]}
    else:
        for name, values in (
            ("scales", cloud.log_scales),
            ("sh0", np.column_stack([dc, cloud.opacity_logits])),
        ):
            low, high = values.min(axis=0), values.max(axis=0)
            bounds = {"mins": low.tolist(), "maxs": high.tolist()}
            meta[name] = {**bounds, "files": [put(name, steps(values, low, high, 255))]}
    if labels is not None:
        k = cloud.sh.shape[1] - 1
        palette = cloud.sh[:PALETTE, 1:]
        if version == 2:
            book = np.linspace(-0.9, 0.9, 256)
            extra = {"count": PALETTE, "bands": int(np.sqrt(k + 1)) - 1, "codebook": book.tolist()}
            codes = nearest(book, palette)
        else:
            extra = {"mins": -0.9, "maxs": 0.9}
            codes = steps(palette, np.float32(-0.9), np.float32(0.9), 255)
        centroids = put("shN_centroids", codes.reshape(PALETTE // 64, 64 * k, 3).astype(np.uint8))
        pixels = np.column_stack([labels & 255, labels >> 8, np.zeros(COUNT)])
        meta["shN"] = {**extra, "files": [centroids, put("shN_labels", pixels)]}
    (folder / "meta.json").write_text(json.dumps(meta))
    return meta


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back_within_their_quantum(
    make_cloud: Make, tmp_path: Path, version: int, degree: int
) -> None:
    cloud = make_cloud(COUNT, degree)
    labels = np.random.default_rng(0).integers(0, PALETTE, COUNT) if degree else None
    write_sog(tmp_path, cloud, version, labels)
    if labels is not None:
        cloud.sh[:, 1:] = cloud.sh[labels, 1:]
    back = importer_for(tmp_path / "meta.json").read(tmp_path / "meta.json")
    difference(back, cloud).assert_below(
        position=4 * 3 / 65535,
        rotation_degrees=0.9,
        log_scale=0.501 * 5 / 255,
        opacity=0.501 / 255 if version == 2 else 0.25 * 0.501 * 8 / 255,
        sh=max(0.501 * 3.55 / 255, 0.501 * 1.8 / 255),
    )


def test_bundles_and_folders_are_the_same(make_cloud: Make, tmp_path: Path) -> None:
    folder = tmp_path / "unpacked"
    write_sog(folder, make_cloud(COUNT, 1), 2, np.arange(COUNT) % PALETTE)
    plain, report = read_scene(folder)
    assert (report.count, report.sh_degree, report.scale_count) == (COUNT, 1, 3)
    for prefix in ("", "inside/"):
        with zipfile.ZipFile(tmp_path / "a.sog", "w") as bundle:
            for file in folder.iterdir():
                bundle.write(file, prefix + file.name)
        assert importer_for(tmp_path / "a.sog").name == "sog"
        zipped, _ = read_scene(tmp_path / "a.sog")
        np.testing.assert_array_equal(zipped.sh, plain.sh)
        np.testing.assert_array_equal(zipped.quats_wxyz, plain.quats_wxyz)


def test_sog_inconsistent_file_is_refused(make_cloud: Make, tmp_path: Path) -> None:
    cloud = make_cloud(COUNT, 1)

    def refused(match: str, **changes: Any) -> None:
        meta = write_sog(tmp_path, cloud, 2, np.arange(COUNT) % PALETTE)
        for name, change in changes.items():
            meta[name] = {**meta[name], **change} if isinstance(change, dict) else change
        (tmp_path / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(SceneFileError, match=match) as caught:
            read_scene(tmp_path / "meta.json")
        assert "meta.json" in str(caught.value)

    refused("is SOG version 3", version=3)
    refused("holds no Gaussians", count=0)
    refused(r"image means_l\.png holds 224 of 5000", count=5000)
    refused("should have 256 entries", scales={"codebook": [1.0, 2.0]})
    refused("should give 3 bounds", means={"mins": [0.0]})
    refused(r"image gone\.png is missing", quats={"files": ["gone.png"]})
    refused("passwd is missing", quats={"files": ["/etc/passwd/../passwd"]})
    refused("names too few images", means={"files": ["means_l.png"]})
    refused("does not fit 2 bands", shN={"bands": 2})
    refused("does not describe a SOG", sh0=3)
    write_sog(tmp_path, cloud, 2, np.full(COUNT, 300))
    with pytest.raises(SceneFileError, match="name harmonics beyond the 128"):
        read_scene(tmp_path)
    write_sog(tmp_path, cloud, 2)
    (tmp_path / "quats.png").write_bytes((tmp_path / "quats.png").read_bytes()[:60])
    with pytest.raises(SceneFileError, match=r"image quats\.png"):
        read_scene(tmp_path)
    (tmp_path / "a.sog").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(SceneFileError, match=r"a\.sog: "):
        read_scene(tmp_path / "a.sog")


@pytest.mark.real
def test_sog_trained_scene_equals_reference_converter(splats: Path) -> None:
    sog, ply = splats / "playbot_lod3.sog", splats / "playbot_lod3.ply"
    a, b = importer_for(sog).read(sog), read_ply_cloud(ply)
    assert (len(a.means_world), a.sh.shape[1]) == (31000, 9)
    difference(a, b).assert_below(position=1e-6, rotation_degrees=1e-3, log_scale=0.0, opacity=1e-3, sh=0.0)
