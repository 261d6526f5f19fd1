"""What is said of a COLMAP model whose reader is ended from outside."""

import sys
from pathlib import Path

import pytest

from octasplat.service.intake import parser_process
from octasplat.service.intake.model_check import ModelLimits, check_model
from octasplat.workers.storage.local import LocalStorage


def test_reader_that_takes_too_much_processor_time_is_told_so(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path, floor_bytes=0)
    (fault,) = check_model(storage, [], {}, ModelLimits(cpu_seconds=0)).faults
    assert fault.code == "model-timeout" and "processor time" in fault.detail


def test_killed_reader_is_no_matter_of_processor_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"]
    monkeypatch.setattr(parser_process, "python_command", lambda _module: command)
    (fault,) = check_model(LocalStorage(tmp_path, floor_bytes=0), [], {}).faults
    assert fault.code == "model-killed" and "processor time" not in fault.detail
