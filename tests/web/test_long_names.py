"""ZIP files whose names are longer than those of datasets and jobs, sent by the page in headless Chromium."""

from pathlib import Path

import pytest

from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.web_harness import Browse, RunningService
from tests.support.zip_builder import ZipMember, build_zip

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

MAX_NAME = 200
"""Of a dataset and of a job, in characters."""


@pytest.mark.exhaustive
def test_archives_with_long_names_become_jobs(
    service: RunningService, browse: Browse, tmp_path: Path
) -> None:
    files = {**photographs(), **ColmapModelBuilder().files()}
    archives = [tmp_path / f"{letter * 230}.zip" for letter in "gp"]
    for path in archives:
        path.write_bytes(build_zip(*(ZipMember(name, content) for name, content in files.items())))
    found = browse("many", service.url, seconds=60, archives=[str(path) for path in archives])
    assert found["names"] == [f"evening: {letter * 230}"[:MAX_NAME] for letter in "pg"]
    datasets = service.request("GET", "/v1/datasets")["datasets"]
    assert [dataset["name"] for dataset in datasets] == [letter * MAX_NAME for letter in "pg"]
