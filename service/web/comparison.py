"""Variants side by side: figures of several jobs, the settings in which they differ, and their renders."""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from octasplat.service.actions.artifacts import list_artifacts
from octasplat.service.auth import Principal
from octasplat.service.state import Service
from octasplat.service.web.templating import flatten_settings
from octasplat.service.web.view_models import JobRow, job_detail

RENDERS = "renders/"


@dataclass(frozen=True)
class Comparison:
    """Several jobs side by side.

    Attributes:
        rows: the jobs.
        differences: settings that are not the same in all, each with a value for every job.
        views: names of renders that at least two of the jobs have.
        view: the one that is shown; None where there is none.
        shown: the jobs that have it.
    """

    rows: list[JobRow]
    differences: list[tuple[str, list[str]]]
    views: list[str]
    view: str | None
    shown: list[JobRow]


async def compare_jobs(
    service: Service, principal: Principal, ids: Sequence[uuid.UUID], view: str | None
) -> Comparison:
    """Return jobs side by side, the best first.

    Raises:
        ProblemError: 404 if one does not exist or the principal may not see it.
    """
    rows = [(await job_detail(service, principal, job_id)).line for job_id in ids]
    rows.sort(key=lambda row: -(row.psnr or 0.0))
    renders = {
        row.job.id: {
            artifact.name.removeprefix(RENDERS)
            for artifact in await list_artifacts(service, principal, row.job.id)
            if artifact.name.startswith(RENDERS)
        }
        for row in rows
    }
    every = sorted(set().union(*renders.values()))
    views = [name for name in every if sum(name in names for names in renders.values()) > 1]
    shown_view = view if view in views else next(iter(views), None)
    return Comparison(
        rows,
        differing_settings([row.job.options for row in rows]),
        views,
        shown_view,
        [row for row in rows if shown_view in renders[row.job.id]],
    )


def differing_settings(options: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Return the settings that are not the same in all options, with a dash where one lacks them."""
    flat = [dict(flatten_settings(values)) for values in options]
    names = sorted({name for values in flat for name in values})
    rows = [(name, [values.get(name, "–") for values in flat]) for name in names]
    return [(name, values) for name, values in rows if len(set(values)) > 1]
