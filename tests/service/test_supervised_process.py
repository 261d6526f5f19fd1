"""What keeps a service's processes goes on trying, whatever it is that they cannot be started for."""

import asyncio
import logging
from pathlib import Path

import pytest

from octasplat.workers.serve.supervised_process import SupervisedProcess, kill_after_timeout


async def test_supervised_process_start_failure_is_logged_and_retried(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program = tmp_path / "program"

    with caplog.at_level(logging.ERROR):
        child = SupervisedProcess("the program", (str(program),), {})
        kept = asyncio.create_task(child.supervise())
        async with asyncio.timeout(120):
            while child.last_exit_code is None:
                await asyncio.sleep(0.02)
            refused = child.last_exit_code
            program.write_text("#!/bin/sh\nexit 7\n")
            program.chmod(0o700)
            while child.last_exit_code != 7:
                assert not kept.done()
                await asyncio.sleep(0.02)
        child.stop()
        await kept
    assert refused == 127
    assert f"the program cannot be started: [Errno 2] No such file or directory: '{program}'" in caplog.text


async def test_supervised_process_ignoring_stop_is_killed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    deaf, ready = tmp_path / "deaf", tmp_path / "ready"
    deaf.write_text(f"#!/bin/sh\ntrap '' TERM\ntouch {ready}\nwhile :; do sleep 0.1; done\n")
    deaf.chmod(0o700)

    with caplog.at_level(logging.WARNING):
        children = [
            SupervisedProcess("the deaf one", (str(deaf),), {}),
            SupervisedProcess("the other", ("sleep", "600"), {}),
        ]
        kept = [asyncio.create_task(child.supervise()) for child in children]
        async with asyncio.timeout(120):
            while not (ready.exists() and all(child.pid for child in children)):
                await asyncio.sleep(0.02)
            for child in children:
                child.stop()
            await kill_after_timeout(children, kept, 1.0)
    assert [child.last_exit_code for child in children] == [-9, -15]
    assert caplog.messages == ["the deaf one does not end and is killed"]
