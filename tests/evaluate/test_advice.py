"""What would help: sentences by the measurements of a run, in its metrics, its report and its summary."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.evaluate.advice import ViewFacts, advise, common_structure, fine_detail
from octasplat.engine.evaluate.gallery import magma
from octasplat.engine.evaluate.summary import summarize_run
from octasplat.engine.evaluate.view_metrics import ViewMetrics
from octasplat.engine.evaluate.view_support import UNKNOWN_GRAY, Support, coverage_picture
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import resolve_config
from tests.support.tiny_dataset import make_tiny_dataset


def view(name: str, psnr: float, corrected: float | None = None) -> ViewMetrics:
    return ViewMetrics(name, 8, 8, psnr, psnr if corrected is None else corrected, None, None, None, None)


def facts(
    counts: list[int], errors: list[float], detail: tuple[float, float] = (1.0, 1.0), structure: float = 0.9
) -> ViewFacts:
    support = Support(np.arange(len(counts)), np.array(counts), np.array(errors))
    return ViewFacts(*detail, support, structure)


WELL_COVERED = facts([9] * 10, [0.001] * 10)


def told(*views: ViewMetrics, training_psnr: float | None = None, **known: ViewFacts) -> str:
    by_name = {each.name: known.get(each.name, WELL_COVERED) for each in views}
    return " ".join(advise(views, by_name, training_psnr=training_psnr, learns_exposure=False))


def test_nothing_is_told_where_nothing_stands_out() -> None:
    assert told(view("a", 30.0), view("b", 31.0), training_psnr=32.5) == ""


def test_badly_covered_places_ask_for_photographs() -> None:
    # 3 of 10 pixels are seen by two views at most; their error is 0.1, that of the others 0.001
    poor = facts([0, 1, 2, 9, 9, 9, 9, 9, 9, 9], [0.1] * 3 + [0.001] * 7)
    sentence = told(view("good", 30.0), view("poor", 20.0), poor=poor)
    # of both views: 3 of 20 pixels, 0.3 of 0.317 of the error; all at 0.001 would be 10 log10(0.317 / 0.02)
    assert "15 % of the held-out pixels" in sentence and "95 % of the error" in sentence
    assert f"{10 * np.log10(0.317 / 0.02):.1f} dB higher" in sentence
    assert "these views: poor, good" in sentence


def test_where_nothing_is_covered_no_gain_is_told() -> None:
    bare = facts([0] * 19 + [9], [0.02] * 19 + [0.0001])
    sentence = told(view("bare", 17.0), bare=bare)
    assert "95 % of the held-out pixels" in sentence and "dB higher" not in sentence


def test_other_colors_and_blur_are_named() -> None:
    views = [view("dark", 20.0, 25.0), view("even", 28.0, 28.2), view("blurred", 27.0)]
    sentence = told(*views, blurred=facts([9], [0.001], (0.3, 0.9)))
    assert "1 held-out photographs have other colors than the rest (dark)" in sentence
    assert "exposure=true" in sentence
    assert "1 held-out photographs are less sharp than their renders (blurred)" in sentence
    # less detail than the render's alone may be noise of the render
    assert "sharp" not in told(view("smooth", 27.0), view("b", 27.0), smooth=facts([9], [0.001], (0.9, 3.0)))


def test_photographs_in_a_wrong_place_are_not_told_to_have_other_colors() -> None:
    dark, astray = facts([9], [0.001], structure=0.6), facts([9], [0.001], structure=0.2)
    views = [view("dark", 20.0, 25.0), view("even", 28.0, 28.2), view("astray", 15.0, 19.0), view("b", 27.0)]
    sentence = told(*views, dark=dark, astray=astray)
    assert "1 held-out photographs have other colors than the rest (dark)" in sentence
    assert "1 held-out photographs show other things than the scene does" in sentence
    assert "other colors (astray): their poses are more likely wrong" in sentence
    # where nothing has much in common, as after a short training, nothing stands out
    poor = facts([9], [0.001], structure=0.2)
    assert "have other colors than the rest (dark, astray)" in told(
        *views, dark=poor, astray=poor, even=poor, b=poor
    )


def room(shift_px: int) -> np.ndarray:
    """Return a picture of boards of other brightness, from a place that is moved along them."""
    rng = np.random.default_rng(0)
    boards = np.kron(rng.uniform(0.2, 0.6, (24, 64)), np.ones((12, 12)))[:, shift_px : shift_px + 360]
    return np.repeat(boards[..., None], 3, axis=2).astype(np.float32)


def test_common_structure_is_that_of_one_place_in_whatever_colors() -> None:
    here, there, whole = room(0), room(204), np.ones((288, 360), np.float32)
    other_light = np.clip(here * np.array([1.5, 1.0, 0.6]) + np.linspace(0, 0.3, 360)[None, :, None], 0, 1)
    assert common_structure(here, here, whole) == pytest.approx(1.0)
    assert common_structure(here, other_light.astype(np.float32), whole) > 0.95
    assert abs(common_structure(there, here, whole)) < 0.15
    half = np.zeros_like(whole)
    half[:, :180] = 1.0
    mixed = np.where(half[..., None] > 0, here, there)
    assert common_structure(mixed, here, half) == pytest.approx(1.0)
    assert np.isnan(common_structure(here, np.full_like(here, 0.5), whole))
    assert np.isnan(common_structure(here, here, np.zeros_like(whole)))


@pytest.mark.parametrize(
    ("training", "held_out", "words"),
    [(26.0, 25.5, "longer training or more Gaussians"), (33.0, 27.0, "more photographs help")],
)
def test_training_views_tell_whether_fit_or_photographs_lack(
    training: float, held_out: float, words: str
) -> None:
    assert words in told(view("a", held_out), training_psnr=training)
    # of views that may have been trained on, the difference says nothing
    seen = advise(
        [view("a", held_out)], {}, training_psnr=training, learns_exposure=False, are_held_out=False
    )
    assert seen == ()


def test_detail_is_that_of_fine_structure() -> None:
    x = np.arange(64)
    fine = np.broadcast_to((x % 2)[None, :, None], (64, 64, 3)).astype(np.float32)
    slope = np.broadcast_to((x / 64)[None, :, None], (64, 64, 3)).astype(np.float32)
    whole = np.ones((64, 64), np.float32)
    # of an alternating pattern the Laplacian is +-2 in the middle
    assert fine_detail(fine, whole) == pytest.approx(4.0, rel=0.05)
    assert fine_detail(slope, whole) < 1e-5
    inner = np.zeros((64, 64), np.float32)
    inner[:, 8:-8] = 1.0
    assert fine_detail(fine, inner) == pytest.approx(4.0, rel=1e-6)
    assert fine_detail(fine, np.zeros((64, 64), np.float32)) == 0.0


def test_coverage_is_bright_where_nobody_looks() -> None:
    # pixels 5 and 7 of the second row of a 10 x 6 view, with a stride of 3 in the middle of their cells
    support = Support(np.array([14, 17]), np.array([0, 9]), np.zeros(2))
    picture = coverage_picture(support, 10, 6, 3)
    assert picture.shape == (6, 10, 3)
    np.testing.assert_allclose(picture[0:3, 3:6], np.broadcast_to(magma(np.ones(1, np.float32)), (3, 3, 3)))
    np.testing.assert_allclose(picture[0:3, 6:9], np.broadcast_to(magma(np.zeros(1, np.float32)), (3, 3, 3)))
    assert (picture[3:] == np.float32(UNKNOWN_GRAY)).all()


@pytest.mark.heavy
def test_run_tells_what_would_help(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    scene = make_tiny_dataset(tmp_path_factory)  # 8 views all around: places are seen from one side only
    config = resolve_config(
        "fast",
        settings={"exports": (), "test_every": 4},
        assignments=["iterations=200", "rays_per_batch=512", "max_gaussians=400", "probe_rays=256"],
    )
    run = reconstruct(scene, tmp_path / "run", config)
    metrics = json.loads((run / "metrics.json").read_text())
    first = metrics["advice"][0]
    assert first.startswith("More photographs would help")
    assert sum(group["pixels"] for group in metrics["coverage"].values()) == pytest.approx(1.0)
    page = (run / "report.html").read_text()
    assert "What would help" in page and "Coverage" in page
    assert first in summarize_run(run, ())
    shutil.rmtree(run / "cache")
