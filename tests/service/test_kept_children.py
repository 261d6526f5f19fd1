"""What keeps a service's processes goes on trying, whatever it is that they cannot be started for."""

import asyncio
import logging
from pathlib import Path

import pytest

from octasplat.workers.serve.children import KeptChild, kill_late


def test_what_cannot_be_started_is_told_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    program = tmp_path / "program"

    async def keep() -> int | None:
        child = KeptChild("the program", (str(program),), {})
        kept = asyncio.create_task(child.keep())
        async with asyncio.timeout(120):
            while child.last_code is None:
                await asyncio.sleep(0.02)
            refused = child.last_code
            program.write_text("#!/bin/sh\nexit 7\n")
            program.chmod(0o700)
            while child.last_code != 7:
                assert not kept.done()
                await asyncio.sleep(0.02)
        child.stop()
        await kept
        return refused

    with caplog.at_level(logging.ERROR):
        assert asyncio.run(keep()) == 127
    assert f"the program cannot be started: [Errno 2] No such file or directory: '{program}'" in caplog.text


def test_what_does_not_end_is_killed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    deaf, ready = tmp_path / "deaf", tmp_path / "ready"
    deaf.write_text(f"#!/bin/sh\ntrap '' TERM\ntouch {ready}\nwhile :; do sleep 0.1; done\n")
    deaf.chmod(0o700)

    async def keep() -> list[int | None]:
        children = [KeptChild("the deaf one", (str(deaf),), {}), KeptChild("the other", ("sleep", "600"), {})]
        kept = [asyncio.create_task(child.keep()) for child in children]
        async with asyncio.timeout(120):
            while not (ready.exists() and all(child.pid for child in children)):
                await asyncio.sleep(0.02)
            for child in children:
                child.stop()
            await kill_late(children, kept, 1.0)
        return [child.last_code for child in children]

    with caplog.at_level(logging.WARNING):
        assert asyncio.run(keep()) == [-9, -15]
    assert caplog.messages == ["the deaf one does not end and is killed"]
