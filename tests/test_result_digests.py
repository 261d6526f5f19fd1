"""The same settings give the results that are stored, or the version of the results is raised."""

import re
from pathlib import Path

import pytest

from benchmarks.result_digests import machine_key, make_digests, read_stored, with_digests
from octasplat.engine.core.versions import RESULTS_VERSION

ROOT = Path(__file__).resolve().parents[1]
STORE = "python -m benchmarks.result_digests --write"


def test_results_are_those_of_their_version(tmp_path: Path) -> None:
    stored = read_stored()
    assert stored["results_version"] == RESULTS_VERSION, f"RESULTS_VERSION was changed; run {STORE}."
    known = stored["machines"].get(machine_key())
    if known is None:
        pytest.skip(f"No digests are stored for this CPU and these packages; {STORE} stores them.")
    found = make_digests(tmp_path)
    differing = [name for name in known if found[name] != known[name]]
    assert not differing, (
        f"The same settings give another {' and '.join(differing)} than at RESULTS_VERSION "
        f"{RESULTS_VERSION}. "
        "If that is meant, raise RESULTS_VERSION in engine/core/versions.py, say in CHANGELOG.md "
        f"why (`RESULTS` is {RESULTS_VERSION + 1}: ...), and run {STORE}."
    )


def test_changelog_tells_of_results_version() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    told = [int(number) for number in re.findall(r"^- `RESULTS` is (\d+):", changes, re.MULTILINE)]
    assert told and told[0] == RESULTS_VERSION


def test_differing_digests_are_stored_under_new_version_only() -> None:
    stored = {"results_version": 3, "machines": {"a": {"training": "1"}, "b": {"training": "2"}}}
    with pytest.raises(ValueError, match="raise it"):
        with_digests(stored, "a", {"training": "3"}, 3)
    assert with_digests(stored, "c", {"training": "3"}, 3)["machines"] == {
        "a": {"training": "1"}, "b": {"training": "2"}, "c": {"training": "3"},
    }  # fmt: skip
    assert with_digests(stored, "a", {"training": "3"}, 4) == {
        "results_version": 4,
        "machines": {"a": {"training": "3"}},
    }
