"""``benchmarks.gallery`` on folders as a training leaves them: views that are shown, pictures, page."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import gallery, gallery_scenes
from benchmarks.gallery_scenes import between_path, scene_figures, widest_gap
from octasplat.engine.dataset.views_file import ViewsRecord
from octasplat.engine.render.image_files import read_image, write_png
from octasplat.engine.render.path_document import PathDocument

WIDTH, HEIGHT = 24, 16
PLACES = [0.0, 1.0, 2.2, 3.0, 3.5, 4.0, 4.2, 4.4]
"""Of the cameras along x; every other one is held out."""


def views_record() -> ViewsRecord:
    views = [
        {
            "name": f"view_{k}.png",
            "camera": 0,
            "rotation_cam_from_world": np.eye(3).tolist(),
            "translation_cam_from_world": [-x, 0.0, 0.0],
            "photograph_sha256": "0",
            "mask_sha256": None,
            "held_out": k % 2 == 0,
            **dict.fromkeys(("width_px", "photograph_width_px"), WIDTH),
            **dict.fromkeys(("height_px", "photograph_height_px"), HEIGHT),
        }
        for k, x in enumerate(PLACES)
    ]
    camera = {"model": "PINHOLE", "params": [30, 31, 12, 8], "width_px": WIDTH, "height_px": HEIGHT}
    content = {"extent_world": 3, "points_sha256": "0", "cameras": [camera], "views": views}
    return ViewsRecord.model_validate(content)


def fake_training(folder: Path, psnrs: list[float], cpu_seconds: float | None = 61.4) -> None:
    """Write what the gallery reads of a training; photographs are half transparent."""
    record = views_record()
    held_out = [view.name for view in record.views if view.held_out]
    rows = {name: {"psnr": psnr, "ssim": psnr / 40} for name, psnr in zip(held_out, psnrs, strict=True)}
    metrics = {
        "mean": {"psnr": float(np.mean(psnrs)), "ssim": 0.75},
        "views": rows,
        "gaussians": 1234,
        "background": "black",
        "versions": {"octasplat": "0.9"},
        "training_views": {"psnr": 33.0},
    }
    run = folder / "run"
    run.mkdir(parents=True, exist_ok=True)
    (run / "metrics.json").write_text(json.dumps(metrics))
    (run / "views.json").write_text(record.model_dump_json())
    (folder / "cost.json").write_text(json.dumps({"cpu_seconds": cpu_seconds}))
    for k, view in enumerate(record.views):
        color = np.full((HEIGHT, WIDTH, 3), 0.1 * k, np.float32)
        half = np.full((HEIGHT, WIDTH), 0.5, np.float32)
        write_png(folder / "photographs" / "images" / view.name, color, half)
        if view.held_out:
            write_png(run / "renders" / view.name, color / 2)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run the gallery of ``table`` on a training with such PSNRs, which is not run."""

    def make(psnrs: list[float], *options: str) -> Path:
        output = tmp_path / options[options.index("-o") + 1]
        monkeypatch.setattr(gallery, "train", lambda _name, folder, *_: fake_training(folder, psnrs))
        gallery.main(["--scenes", "table", "--runs", str(tmp_path / "runs"), *options])
        return output

    def draw(_run: Path, picture: Path, *, camera_path: dict[str, object], **_: object) -> None:
        path = PathDocument.model_validate(camera_path)
        assert path.frame_count == 1
        write_png(picture, np.full((path.height, path.width, 3), 0.9, np.float32))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gallery_scenes.osp, "render", draw)
    return make


def test_view_between_is_halfway_across_the_widest_gap_of_training_views() -> None:
    viewpoints = views_record().viewpoints(None)
    names = widest_gap(viewpoints)
    assert names == ("view_1.png", "view_3.png")  # at 1 and 3; the others' neighbours are nearer
    (frame,) = PathDocument.model_validate(between_path(viewpoints, names)).frames or ()
    assert [row[3] for row in frame.camera_to_world] == pytest.approx([2.0, 0, 0, 1])
    assert (frame.fx, frame.fy, frame.cx, frame.cy) == (30, 31, 12, 8)


def test_worst_and_median_view_are_shown_until_others_are_chosen(tmp_path: Path) -> None:
    fake_training(tmp_path, [25.0, 30.0, 21.0, 28.0])
    first = scene_figures(tmp_path, "fast")
    assert (first.worst.name, first.median.name) == ("view_4.png", "view_6.png")
    fake_training(tmp_path, [20.0, 30.0, 24.0, 28.5], cpu_seconds=None)
    later = scene_figures(tmp_path, "fast", first)
    assert (later.worst.name, later.worst.psnr, later.median.psnr) == ("view_4.png", 24.0, 28.5)
    assert (later.worst_now.name, later.worst_now.psnr, later.cpu_seconds) == ("view_0.png", 20.0, None)


def test_gallery_keeps_what_people_wrote_and_shows_an_earlier_one_beside(made) -> None:
    old = made([25.0, 30.0, 21.0, 28.0], "-o", "old")
    page = old / "gallery.md"
    page.write_text(page.read_text().replace("# Gallery", "# Gallery\n\nThe cup is a blur."))
    assert "21.00 dB" in page.read_text() and "61 s" in page.read_text()
    made([26.0, 31.0, 22.5, 29.0], "-o", "old")
    text = page.read_text()
    assert "The cup is a blur." in text and "22.50 dB" in text and "21.00 dB" not in text
    assert text.count("## Things on a table") == 1 and "Earlier" not in text

    new = made([27.0, 20.0, 23.0, 29.0], "-o", "new", "--compare", "old")
    text = (new / "gallery.md").read_text()
    assert "| 20.00 dB (22.50 dB) |" in text and "view_4.png, 23.00 dB" in text
    pictures = sorted(path.relative_to(new).as_posix() for path in new.rglob("*.jpg"))
    assert len(pictures) == 6 and all(f"]({path})" in text for path in pictures)


def test_strips_hold_photograph_render_and_error_side_by_side(made) -> None:
    output = made([25.0, 30.0, 21.0, 28.0], "-o", "new")
    worst = read_image(output / "images" / "gallery" / "table_worst.jpg")
    assert worst.shape == (HEIGHT, 3 * WIDTH, 3)
    middles = [worst[HEIGHT // 2, WIDTH // 2 + k * WIDTH, 0] for k in range(3)]
    assert middles == pytest.approx([0.2, 0.2, 0.0], abs=0.03)  # 0.4 at half coverage over black
    between = read_image(output / "images" / "gallery" / "table_between.jpg")
    assert between[HEIGHT // 2, WIDTH + WIDTH // 2] == pytest.approx([0.9] * 3, abs=0.03)


@pytest.mark.parametrize(
    ("options", "said"),
    [(["--compare", "none"], "no figures of a gallery"), (["-o", "a", "--compare", "a/"], "2")],
)
def test_wrong_folders_are_refused(tmp_path: Path, monkeypatch, options: list[str], said: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=said):
        gallery.main(["--scenes", "table", *options])
    assert not list(tmp_path.iterdir())
