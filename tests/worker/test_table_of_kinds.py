"""The table of kinds: what is in it, and that a job's process loads no other kinds than its own."""

import subprocess
import sys
from pathlib import Path

import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.worker.job_kinds import get_job_kind, job_kinds, register
from octasplat.workers.worker.job_kinds.registry import _KINDS
from tests.support import toy_kind

IMPORTS_OF_A_TOY = """
import sys
import octasplat.workers.worker.job_process, tests.support.toy_kind
from octasplat.workers.worker.job_kinds import get_job_kind
assert get_job_kind("toy").program == "tests.support.toy_kind:run"
heavy = {"numpy", "octasplat.engine.operations", "octasplat.workers.worker.job_kinds.builtin"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


def test_process_of_another_kind_loads_no_built_in_one() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS_OF_A_TOY],
        capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2], timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_built_in_kinds_come_before_others() -> None:
    names = [kind.name for kind in job_kinds()]
    assert names[0] == "reconstruct" and names.index("import") < names.index("toy")
    assert get_job_kind("toy").options is toy_kind.ToyOptions


def test_unknown_kind_is_told_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"no job kind 'paint'; choose one of reconstruct, .*toy"):
        get_job_kind("paint")


def test_two_kinds_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="'toy' is registered already"):
        register(get_job_kind("toy"))
    monkeypatch.setitem(_KINDS, "info", get_job_kind("toy"))
    with pytest.raises(ValueError, match="'info' is built in already"):
        job_kinds()
