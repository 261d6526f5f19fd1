"""What a child said reaches the journal whole, whenever the end comes."""

import asyncio
from typing import Any

import pytest

from workers.work import reporter
from workers.work.reporter import Reporter


class SlowJournal:
    """An attempt whose database takes its time for each event."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.telling = asyncio.Event()

    async def tell(self, kind: str, data: dict[str, Any]) -> None:
        self.telling.set()
        await asyncio.sleep(0.05)
        self.told.append(f"{kind} {data.get('stage', '')}".strip())

    async def progress(self, **_progress: object) -> None:
        await asyncio.sleep(0)

    async def log(self, _lines: tuple[str, ...]) -> None:
        await asyncio.sleep(0)


def test_an_end_in_the_middle_of_writing_loses_and_repeats_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reporter, "FLUSH_SECONDS", 0.01)

    async def job() -> list[str]:
        journal = SlowJournal()
        child = Reporter(journal, workspace=None)  # type: ignore[arg-type]
        for stage in ("load", "evaluate", "export"):
            child.hear({"kind": "stage_started", "stage": stage, "total_steps": 0})
            child.hear({"kind": "stage_finished", "stage": stage, "seconds": 1.0})
        await journal.telling.wait()  # the first event is being written, five more were taken
        child.hear({"kind": "run_finished", "outputs": [], "seconds": 3.0})
        await child.finish()
        return journal.told

    stages = [
        f"stage_{what} {stage}"
        for stage in ("load", "evaluate", "export")
        for what in ("started", "finished")
    ]
    assert asyncio.run(job()) == [*stages, "run_finished"]
