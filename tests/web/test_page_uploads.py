"""What the page sends: large files in parts that go on after a break; nothing that its owner has stored."""

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.dataset.synthetic.files import write_photograph
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

PART_BYTES = 8 << 20


def write_photographs(folder: Path) -> Path:
    """A photograph of noise, which no PNG makes shorter than 32 MiB, and three small ones."""
    random = np.random.default_rng(5)
    for name, side in (("large", 3400), ("a", 40), ("b", 41), ("c", 42)):
        path = folder / "images" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_photograph(path, random.integers(0, 256, (side, side, 3), np.uint8))
    return folder


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photographs(tmp_path_factory.mktemp("large") / "first")


def digests(service: RunningService, job: str) -> dict[str, str]:
    """Of the files of a job's dataset, by name."""
    dataset = service.request("GET", f"/v1/jobs/{job}")["dataset_id"]
    assert service.request("GET", f"/v1/datasets/{dataset}")["state"] == "committed"
    files = service.request("GET", f"/v1/datasets/{dataset}/files")["files"]
    return {file["path"]: file["sha256"] for file in files}


@pytest.mark.exhaustive
def test_large_files_go_on_in_parts_and_known_ones_are_not_sent(
    service: RunningService, browse: Browse, photographs: Path
) -> None:
    changed = photographs.with_name("second")
    shutil.copytree(photographs, changed)
    write_photograph(changed / "images" / "b.png", np.zeros((50, 50, 3), np.uint8))
    large = (photographs / "images" / "large.png").read_bytes()
    starts = range(0, len(large), PART_BYTES)
    found: dict[str, Any] = browse("sent", service.url, chosen=[str(photographs), str(changed)], cut=5)
    begun, rest, second = found["puts"]
    parts = {f"uploads/ID/parts/{start}" for start in starts}
    assert len(parts) == 5 and set(begun) < parts | {f"files/images/{name}.png" for name in "abc"}
    # Each is sent once, before the break or after it.
    assert len(begun) == 5 and not set(begun) & set(rest)
    assert set(begun) | set(rest) == parts | {f"files/images/{name}.png" for name in "abc"}
    assert second == ["files/images/b.png"]
    for job, folder in zip(found["jobs"], (photographs, changed), strict=True):
        wanted = {
            f"images/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest()
            for path in (folder / "images").iterdir()
        }
        assert digests(service, job) == wanted


@pytest.mark.exhaustive
def test_large_archive_goes_on_in_parts(
    service: RunningService, browse: Browse, photographs: Path, tmp_path: Path
) -> None:
    archive = shutil.make_archive(str(tmp_path / "photographs"), "zip", photographs)
    found = browse("sent", service.url, chosen=[archive], cut=3)
    begun, rest = found["puts"]
    parts = {f"uploads/ID/parts/{start}" for start in range(0, Path(archive).stat().st_size, PART_BYTES)}
    assert len(begun) == 3 and not set(begun) & set(rest) and set(begun) | set(rest) == parts
    assert sorted(digests(service, found["jobs"][0])) == [f"images/{n}.png" for n in ("a", "b", "c", "large")]


def test_others_are_not_sent_again_where_one_file_is_refused(
    service: RunningService, browse: Browse, tmp_path: Path
) -> None:
    random = np.random.default_rng(6)
    (tmp_path / "photos").mkdir()
    for name in "abc":
        write_photograph(tmp_path / "photos" / f"{name}.png", random.integers(0, 256, (40, 40, 3), np.uint8))
    (tmp_path / "photos" / "bad.png").write_bytes(b"no picture")
    found = browse("refused", service.url, chosen=str(tmp_path / "photos"))
    assert found["begun"] >= 2 and found["late"] == 0 and not found["going"]
    assert any("bad.png" in fault for fault in found["faults"])
