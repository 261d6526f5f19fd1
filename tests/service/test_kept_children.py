"""What keeps a service's processes goes on trying, whatever it is that they cannot be started for."""

import asyncio
import logging
from pathlib import Path

import pytest

from workers.serve.children import KeptChild


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
