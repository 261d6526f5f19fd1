"""The report in headless Chromium."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.evaluate.gallery import ViewImages
from octasplat.engine.evaluate.report import write_report
from tests.support.browser import open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

MEASURE = """<script>window.result = [document.documentElement, document.querySelector(".list")]
    .map((part) => { part.scrollLeft = 100; return part.scrollLeft; })</script></body>"""


@pytest.mark.parametrize("width", [1200, 800])
def test_report_table_fits_page(tmp_path: Path, width: int) -> None:
    figures = {"psnr": 25.125, "ssim": 0.9012, "ssim_valid": 0.8912, "ms_ssim": 0.9512, "flip": 0.1012}
    names = [f"a_photograph_with_a_long_name_{number:04}.jpg" for number in range(8)]
    picture = np.full((20, 30, 3), 0.5, np.float32)
    write_report(
        tmp_path / "report.html",
        title="plush",
        metrics={
            "mean": figures, "mean_psnr_ci95": [24.0, 26.0], "definitions": {}, "gaussians": 1, "seed": 0,
            "iterations": 1, "seconds": 1.0,
            "views": {name: figures | {"width": 1920, "height": 1080} for name in names},
        },
        events=[],
        config={},
        images={name: ViewImages(picture, picture, picture[..., 0]) for name in names},
    )  # fmt: skip
    html = (tmp_path / "report.html").read_text(encoding="utf-8").replace("</body>", MEASURE)
    page = open_page(html, width=width, height=860)
    assert page.result == [0, 0]
