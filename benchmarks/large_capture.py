"""A capture of thousands of photographs of 12 megapixels, as a camera with GPS writes them.

    python -m benchmarks.large_capture FOLDER [--views 2000] [--houses 24] [--share K/N]

Writes ``FOLDER/gps/images/IMG_0000.jpg`` and on, photographs of the generated street
(``octasplat.engine.dataset.synthetic``) of 4000 x 3000 pixels with GPS in their EXIF, off by a meter
(standard deviation), and the same photographs without GPS in ``FOLDER/no_gps``. They are rendered at
1000 x 750 pixels, enlarged, and get grain, so that the files are as large as a camera's. The true poses are
in ``FOLDER/truth``. What is there already is kept. ``--share 0/2`` and ``--share 1/2`` are the two halves
of the work, for two processes.
"""

import argparse
import io
from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8
from PIL import Image

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, synthetic_views
from octasplat.engine.dataset.synthetic.colmap_writer import write_model
from octasplat.engine.dataset.synthetic.photograph_renderer import PhotographRenderer
from octasplat.engine.dataset.synthetic.points import sample_surface_points
from octasplat.engine.dataset.synthetic.write import cached_lit_scene

SIZE_PX = (4000, 3000)
RENDERED_PX = (1000, 750)
QUALITY = 90
GRAIN = 2.5
"""Standard deviation of the grain, in steps of 8 bits."""
GPS_ERROR_M = 1.0
LATITUDE, LONGITUDE, ALTITUDE_M = 47.3769, 8.5417, 408.0
_METERS_PER_DEGREE = 111_320.0
_FOCAL_MM, _SENSOR_MM = 0.5 * 6.4 / float(np.tan(np.radians(27))), 6.4


def gps_exif(position_m: np.ndarray | None) -> Image.Exif:
    """Return the EXIF of a photograph from ``position_m``, meters east, north and up of the origin."""
    exif = Image.Exif()
    exif[271], exif[272] = "octasplat", "generated street"
    exif.get_ifd(0x8769).update({37386: _FOCAL_MM, 41989: round(_FOCAL_MM * 36 / _SENSOR_MM)})
    if position_m is not None:
        east, north, up = (float(value) for value in position_m)
        latitude = LATITUDE + north / _METERS_PER_DEGREE
        longitude = LONGITUDE + east / (_METERS_PER_DEGREE * np.cos(np.radians(LATITUDE)))
        exif.get_ifd(0x8825).update(
            {1: "N", 2: _dms(latitude), 3: "E", 4: _dms(longitude), 5: b"\0", 6: ALTITUDE_M + up}
        )
    return exif


def _dms(degrees: float) -> tuple[float, float, float]:
    whole, rest = divmod(degrees * 60, 60)
    return float(whole), float(int(rest)), (rest - int(rest)) * 60


def enlarge(pixels: UInt8[np.ndarray, "h w 3"], grain: Int16[np.ndarray, "H W"]) -> Image.Image:
    """Return a photograph at full size with grain."""
    large = np.asarray(Image.fromarray(pixels).resize(SIZE_PX, Image.Resampling.BICUBIC), np.int16)
    return Image.fromarray(np.clip(large + grain[:, :, None], 0, 255).astype(np.uint8))


def as_jpeg(photograph: Image.Image) -> bytes:
    """Return the file of a photograph without EXIF."""
    file = io.BytesIO()
    photograph.save(file, "JPEG", quality=QUALITY)
    return file.getvalue()


def save(path: Path, jpeg: bytes, exif: Image.Exif) -> None:
    """Write a JPEG with EXIF, which stands before all else, completely or not at all."""
    data = exif.tobytes()
    partial = path.with_suffix(".partial")
    partial.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data + jpeg[2:])
    partial.rename(path)


def main() -> None:
    """Write the capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=2000)
    parser.add_argument("--houses", type=int, default=24)
    parser.add_argument("--share", default="0/1")
    given = parser.parse_args()
    number, shares = map(int, given.share.split("/"))
    config = SyntheticDatasetConfig(
        views=given.views, width_px=RENDERED_PX[0], height_px=RENDERED_PX[1], samples_per_side=1,
        points=30 * given.views, scene="street", houses=given.houses,
    )  # fmt: skip
    folders = {kind: given.folder / kind / "images" for kind in ("gps", "no_gps")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    scene = cached_lit_scene("street", given.houses)
    camera, views = synthetic_views.synthetic_camera(config), synthetic_views.synthetic_views(config)
    truth = given.folder / "truth"
    if number == 0 and not truth.exists():
        write_model(truth, camera, views, sample_surface_points(scene, camera, views, config))
    renderer = PhotographRenderer(scene, camera, config)
    random = np.random.default_rng(1)
    errors_m = random.normal(0, GPS_ERROR_M, (len(views), 3))
    grain = random.normal(0, GRAIN, (SIZE_PX[1], SIZE_PX[0])).round().astype(np.int16)
    for k in range(number, len(views), shares):
        name = f"IMG_{k:04d}.jpg"
        if all((folder / name).exists() for folder in folders.values()):
            continue
        moved = np.roll(grain, (97 * k, 31 * k), (0, 1))
        jpeg = as_jpeg(enlarge(renderer.render_pixels(views[k]), moved))
        save(folders["gps"] / name, jpeg, gps_exif(views[k].centre_world + errors_m[k]))
        save(folders["no_gps"] / name, jpeg, gps_exif(None))
        print(name, flush=True)


if __name__ == "__main__":
    main()
