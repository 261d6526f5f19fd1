import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from octasplat.engine.core.errors import OutputError
from octasplat.engine.evaluate.curves import format_axis_duration, training_charts
from octasplat.engine.evaluate.gallery import ViewImages, WorstAndBestViews, magma
from octasplat.engine.evaluate.report import write_report
from octasplat.engine.render.image_files import read_image


class Page(HTMLParser):
    """All tags with their attributes and their direct text, and the rows of the table of views."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data

    def all(self, tag, **having):
        return [
            a for t, a in self.tags if t == tag and all(a.get(k.rstrip("_")) == v for k, v in having.items())
        ]

    @property
    def rows(self):
        return [a["data-view"] for a in self.all("tr") if "data-view" in a]

    @property
    def figures(self):
        return [a["data-view"] for a in self.all("figure")]


def pictures(height=20, width=30, value=0.5):
    photograph = np.full((height, width, 3), value, np.float32)
    flip_map = np.zeros((height, width), np.float32)
    flip_map[:, width // 2 :] = 1.0
    return ViewImages(photograph, 1 - photograph, flip_map)


def metrics_of(values, **changes):
    views = {
        name: {
            "psnr": psnr,
            "ssim": 0.9,
            "ssim_valid": 0.89,
            "ms_ssim": None,
            "flip": 0.1,
            "width": 30,
            "height": 20,
        }
        for name, psnr in values.items()
    }
    mean = {"psnr": 25.125, "ssim": 0.9, "ssim_valid": 0.89, "ms_ssim": None, "flip": 0.1}
    content = {"mean": mean, "mean_psnr_ci95": [24.0, 26.0], "views": views, "definitions": {"psnr": "in dB"}}
    return content | {"gaussians": 12345, "iterations": 500, "seconds": 250.0, "seed": 3} | changes


def progress(iteration, **changes):
    row = {
        "kind": "training_progress",
        "iteration": iteration,
        "loss": 1 / iteration,
        "psnr": 10.0 + iteration,
    }
    return row | {"gaussians": 100 * iteration, "seconds": iteration * 2.0} | changes


EVENTS = [
    *(progress(k) for k in range(1, 11)),
    {"kind": "held_out_measured", "iteration": 5, "psnr": 14.0, "gaussians": 500, "seconds": 10.0},
    {"kind": "held_out_measured", "iteration": 10, "psnr": 18.0, "gaussians": 1000, "seconds": 20.0},
    {"kind": "warning", "message": "two <photographs> were left out"},
    {"kind": "stage_finished", "stage": "train", "seconds": 20.0},
]


@pytest.fixture
def report(tmp_path):
    def write(**changes):
        arguments = {
            "title": "plush",
            "metrics": metrics_of({"b.jpg": 30.0, "a.jpg": 20.0, "c.jpg": 25.0}),
            "events": EVENTS,
            "config": {"train": {"iterations": 500}, "seed": 3},
            "images": {name: pictures() for name in ("a.jpg", "b.jpg", "c.jpg")},
        }
        write_report(tmp_path / "report.html", **(arguments | changes))
        return Page((tmp_path / "report.html").read_text(encoding="utf-8"))

    return write


def test_report_has_no_external_references(report, tmp_path):
    page = report()
    links = [
        value for _, a in page.tags for key, value in a.items() if key in ("src", "href", "srcset", "data")
    ]
    assert links and all(link.startswith("data:image/webp;base64,") for link in links)
    text = (tmp_path / "report.html").read_text()
    assert not re.search(r"https?:|@import|//\w+\.\w+|url\(", text)
    assert [a for a in page.all("meta") if "default-src 'none'" in a.get("content", "")]


def test_report_lists_views_worst_first(report):
    page = report()
    assert page.rows == page.figures == ["a.jpg", "c.jpg", "b.jpg"]
    assert [a.get("aria-sort") for a in page.all("th")].count("ascending") == 1
    shown = [a["data-view"] for a in page.all("figure") if "shown" in a["class"]]
    assert shown == ["a.jpg"]


def test_report_embeds_given_images(report, tmp_path):
    page = report(images={"a.jpg": pictures(value=0.25)})
    images = {a["class"]: a for a in page.all("img")}
    decoded = {}
    for layer, attributes in images.items():
        path = tmp_path / f"{layer}.webp"
        path.write_bytes(base64.b64decode(attributes["src"].split(",")[1], validate=True))
        decoded[layer] = read_image(path)[..., :3]
        assert decoded[layer].shape == (20, 30, 3)
        assert (attributes["width"], attributes["height"]) == ("30", "20")
        assert "a.jpg" in attributes["alt"]
    assert np.allclose(decoded["photograph"], 0.25, atol=0.02)
    assert np.allclose(decoded["render"], 0.75, atol=0.02)
    assert decoded["flip"][10, 3].max() < 0.1
    assert np.allclose(decoded["flip"][10, 27], [0.987, 0.991, 0.75], atol=0.06)


def test_large_images_are_shrunk(report):
    page = report(images={"a.jpg": pictures(400, 1000)})
    assert {(a["width"], a["height"]) for a in page.all("img")} == {("800", "320")}


def test_report_sliders_are_keyboard_accessible(report):
    page = report()
    sliders = page.all("input", type="range")
    assert len(sliders) == 3
    assert all(a["aria-label"] for a in sliders)
    pairs = [a["data-pair"] for a in page.all("button") if "data-pair" in a]
    assert pairs == ["photograph render", "photograph flip", "render flip"]


def test_report_many_views_embeds_worst_and_best(report):
    psnr = {f"{k:02d}.jpg": float(k) for k in range(30)}
    gallery = WorstAndBestViews()
    for name in np.random.default_rng(0).permutation(sorted(psnr)).tolist():
        gallery.offer(name, psnr[name], pictures())
    page = report(metrics=metrics_of(psnr), images=gallery)
    expected = [f"{k:02d}.jpg" for k in (*range(12), *range(26, 30))]
    assert list(gallery) == page.figures == expected
    assert page.rows == sorted(psnr)
    assert "12 worst and 4 best views are embedded; the other 14" in page.text
    assert page.figures == report(metrics=metrics_of(psnr), images=dict.fromkeys(psnr, pictures())).figures


def test_report_sorts_views_without_psnr_last(report):
    page = report(metrics=metrics_of({"a.jpg": None, "b.jpg": 30.0}))
    assert page.rows == ["b.jpg", "a.jpg"]


def test_figures_settings_and_warnings_are_shown_as_text(report):
    hostile = "<script>alert(1)</script>"
    page = report(
        title=hostile,
        metrics=metrics_of({'x" onload="y.jpg': 20.0}),
        images={'x" onload="y.jpg': pictures()},
        config={"note": hostile},
    )
    assert page.text.count(hostile) >= 2
    assert len(page.all("script")) == 2
    assert not [a for _, a in page.tags if "onload" in a]
    assert page.rows == ['x" onload="y.jpg']
    for text in (
        "25.12",
        "24.00 – 26.00",
        "12\u202f345",
        "4 min 10 s",
        "two <photographs> were left out",
        "seed 3",
    ):
        assert text in page.text


def test_report_of_incomplete_run(report):
    page = report(events=[], images={}, config={}, metrics={"mean": {"psnr": 20.0}, "views": {}})
    assert page.rows == page.figures == page.all("svg") == []


@pytest.mark.parametrize(("corrected", "shown"), [(25.2, False), (25.6, True)])
def test_psnr_without_the_exposure_is_shown_where_it_differs(report, corrected, shown):
    metrics = metrics_of({"a.jpg": 25.125})
    metrics["mean"]["psnr_colour_corrected"] = corrected
    metrics["views"]["a.jpg"]["psnr_colour_corrected"] = corrected
    page = report(metrics=metrics)
    assert ("PSNR cc" in page.text) == (f"{corrected:.2f}" in page.text) == shown


def test_report_shows_early_stop(report):
    metrics = metrics_of({"a.jpg": 25.0}) | {"iterations": 3500, "seconds": 60.0}
    assert "as no more was gained" not in report(metrics=metrics).text
    early = report(metrics=metrics | {"planned_iterations": 5000})
    assert "3\u202f500 iterations of 5\u202f000, as no more was gained" in early.text


def test_curves_are_drawn_over_iterations_and_time(report):
    page = report()
    assert len(page.all("svg")) == 6
    labels = [a["data-label"] for a in page.all("polyline")]
    assert labels == ["training rays", "held-out views", "loss", "Gaussians"] * 2


def value_of(chart, curve, index):
    """The value a curve's point stands for, read back from its place."""
    x, y = curve.points[index]
    share_x, share_y = (x - 52) / (408 - 52), (206 - y) / (206 - 12)
    (x0, x1), (y0, y1) = chart.x_range, chart.y_range
    value = y0 + share_y * (y1 - y0)
    return x0 + share_x * (x1 - x0), 10**value if chart.logarithmic else value


def test_points_of_a_curve_stand_for_their_values():
    charts = training_charts(EVENTS)
    psnr, loss, gaussians, psnr_by_time = charts[:4]
    assert value_of(psnr, psnr.curves[1], 1) == pytest.approx((10, 18.0), abs=0.01)
    assert loss.logarithmic
    assert value_of(loss, loss.curves[0], 3) == pytest.approx((4, 0.25), abs=0.01)
    assert value_of(gaussians, gaussians.curves[0], 9) == pytest.approx((10, 1000.0), rel=1e-3)
    assert value_of(psnr_by_time, psnr_by_time.curves[0], 0) == pytest.approx((2, 11.0), abs=0.02)


def test_report_of_resumed_run_uses_later_rows():
    rows = [progress(1), progress(2), progress(3, psnr=99.0), progress(3, psnr=13.0), progress(4)]
    chart = training_charts(rows)[0]
    assert [round(value_of(chart, chart.curves[0], k)[1]) for k in range(4)] == [11, 12, 13, 14]


def test_long_curves_are_thinned_to_their_last_point_and_odd_rows_left_out():
    rows = [progress(k, psnr=20.0, loss=float("nan")) for k in range(1, 5001)]
    charts = training_charts([*rows, {"kind": "training_progress"}, progress(6000, psnr=None, loss=0.0)])
    assert [chart.title for chart in charts[:3]] == ["PSNR", "Loss", "Gaussians"]
    psnr, loss, gaussians = charts[:3]
    assert len(psnr.curves[0].points) <= 302
    assert value_of(psnr, psnr.curves[0], -1)[0] == pytest.approx(5000, rel=1e-3)
    assert not loss.logarithmic and len(loss.curves[0].points) == 1
    assert value_of(gaussians, gaussians.curves[0], -1)[1] == pytest.approx(600000, rel=1e-3)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (3.25, "3.2 s"),
        (59.4, "59 s"),
        (250.0, "4 min 10 s"),
        (600.0, "10 min"),
        (7500.0, "2 h 05 min"),
    ],
)
def test_duration_is_formatted(seconds, text):
    assert format_axis_duration(seconds) == text


def test_axes_have_labelled_ticks_inside_the_plot():
    charts = training_charts(EVENTS)
    assert charts
    for chart in charts:
        assert 2 <= len(chart.x_ticks) <= 8
        assert 2 <= len(chart.y_ticks) <= 12
        assert all(52 <= tick.position <= 408 for tick in chart.x_ticks)
        assert all(12 <= tick.position <= 206 for tick in chart.y_ticks)
        assert len({tick.label for tick in chart.x_ticks}) == len(chart.x_ticks)


def test_error_colors_are_those_of_flip_itself():
    import flip_evaluator

    rng = np.random.default_rng(0)
    a, b = (rng.random((40, 40, 3), dtype=np.float32) for _ in range(2))
    values, _, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False)
    colored, _, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=True)
    assert np.abs(magma(values[..., 0]) - colored).max() < 0.02


def test_report_unwritable_path_raises_output_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"report\.html"):
        write_report(tmp_path / "file" / "report.html", title="", metrics={}, events=[], config={}, images={})
