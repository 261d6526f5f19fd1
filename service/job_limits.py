"""Resource demands of a job, its check against the limits of the service, and its estimate."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import Estimate
from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError
from octasplat.service.settings import ServiceSettings
from octasplat.workers.db.rows import WorkerRow
from octasplat.workers.settings import PREFIX
from octasplat.workers.worker.job_kinds import JobKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand, exceeded_limits

_MEMORY_ESTIMATE_MARGIN = 3
"""Estimates are right within a factor of two; a job above this many times the limit is sure to be stopped."""


def check_job_limits(
    kind: JobKind, options: BaseModel, sizes: Sequence[ImageSizes], settings: ServiceSettings
) -> None:
    """Refuse options that exceed the limits of the service.

    Raises:
        ProblemError: 422, with each such option and its ceiling.
    """
    found = exceeded_limits(kind.resource_demands(options, sizes), settings.ceilings)
    # What it takes on disk follows from the others, so that it is told only if none of them is too much.
    found = [excess for excess in found if excess.demand.resource != "workspace_bytes"] or found
    faults = [
        {
            "pointer": f"#/options/{excess.demand.path.replace('.', '/')}",
            "detail": excess.sentence,
            "ceiling": excess.limit,
            "setting": f"{PREFIX}MAX_{excess.demand.resource.upper()}",
        }
        for excess in found
    ]
    if faults:
        raise ProblemError(422, "ceiling", str(faults[0]["detail"]), errors=faults)


def check_priority(principal: Principal, priority: int, settings: ServiceSettings) -> None:
    """Refuse high priorities of callers who are not administrators.

    Raises:
        ProblemError: 422.
    """
    if priority <= settings.max_priority or principal.may("admin"):
        return
    detail = f"The priority is {priority}; you may give at most {settings.max_priority}, administrators more."
    setting = f"{PREFIX}MAX_PRIORITY"
    fault = {
        "pointer": "#/priority", "detail": detail, "ceiling": settings.max_priority, "setting": setting,
    }  # fmt: skip
    raise ProblemError(422, "ceiling", detail, errors=[fault])


def limits_by_path(kind: JobKind, settings: ServiceSettings) -> dict[str, int]:
    """Return the limit of each option that has one of its own, by path."""
    try:
        options = kind.resolve({})
    except ValueError:  # something has to be given
        return {}
    # What follows from several options is the limit of none of them.
    numbers = [
        demand
        for demand in kind.resource_demands(options, ())
        if demand.resource not in ("exports", "render_pixels", "render_paths", "workspace_bytes")
    ]
    return {
        demand.path: settings.ceilings[demand.resource]
        for demand in numbers
        # Its demand is the square of the option.
        if demand.path != "train.ssim_patch_side"
    }


def estimate_job(
    kind: JobKind, options: BaseModel, sizes: Sequence[ImageSizes], workers: Sequence[WorkerRow]
) -> Estimate | None:
    """Estimate a job on the best of ``workers``, or on a machine like this one if there are none.

    None where nobody knows, as without any photographs whose sizes are known.
    """
    if not sizes:
        return None
    found = kind.estimate(options, sizes, max(map(_cores_per_job, workers), default=os.cpu_count() or 1))
    cold = min(map(_cold_start_seconds, workers), default=0.0)
    return found.with_cold_start(cold) if found is not None and cold else found


def check_workers_large_enough(
    demands: Iterable[ResourceDemand], estimate: Estimate | None, queue: str, workers: Sequence[WorkerRow]
) -> None:
    """Refuse a job that none of the live workers of its queue could ever do.

    Without workers, or where one of them does not say what it has, any job is accepted.

    Raises:
        ProblemError: 422, with what is needed and what there is.
    """
    least = max((d.amount for d in demands if d.resource == "workspace_bytes"), default=0)
    least = max(least, estimate.disk_bytes if estimate is not None else 0)
    capacity = _largest_of_all(workers, "disk_bytes")
    memory = estimate.memory_bytes if estimate is not None else 0
    allowed = _largest_of_all(workers, "memory_limit_bytes")
    if capacity is not None and least > capacity:
        detail = (
            f"The job needs at least {least / 1e9:.1f} GB of disk, and no worker of the queue {queue} has "
            f"more than {capacity / 1e9:.1f} GB; ask for fewer or smaller images."
        )
    elif allowed is not None and memory > _MEMORY_ESTIMATE_MARGIN * allowed:
        detail = (
            f"The job needs about {memory / 1e9:.1f} GB of memory, and no worker of the queue {queue} allows "
            f"more than {allowed / 1e9:.1f} GB; ask for fewer Gaussians, rays or pixels."
        )
    else:
        return
    raise ProblemError(422, "too-large", detail, errors=[{"pointer": "#/options", "detail": detail}])


def limit_notes(
    estimate: Mapping[str, Any] | None, workers: Sequence[WorkerRow], settings: ServiceSettings
) -> list[str]:
    """Return sentences for the owner of a job that will probably reach a limit."""
    if estimate is None:
        return []
    known = Estimate.model_validate(dict(estimate))
    notes = []
    allowed = _largest_of_all(workers, "memory_limit_bytes")
    if allowed is not None and known.memory_bytes > allowed:
        notes.append(
            f"It may need {known.memory_bytes / 1e9:.1f} GB of memory, and its workers allow "
            f"{allowed / 1e9:.1f} GB; ask for fewer Gaussians, rays or pixels."
        )
    capacity = _largest_of_all(workers, "disk_bytes")
    if capacity is not None and known.disk_bytes > capacity:
        notes.append(
            f"It needs at least {known.disk_bytes / 1e9:.1f} GB of disk, and no worker has more than "
            f"{capacity / 1e9:.1f} GB."
        )
    elif capacity is not None and known.max_disk_bytes > capacity:
        notes.append(
            f"It may need up to {known.max_disk_bytes / 1e9:.1f} GB of disk, and no worker has more than "
            f"{capacity / 1e9:.1f} GB; ask for fewer or smaller images, or for another format."
        )
    hours = settings.max_job_hours
    if hours and known.seconds > 3600 * hours:
        notes.append(
            f"It may take {known.seconds / 3600:.0f} hours, and is ended after {hours:g}; ask for less."
        )
    return notes


def _largest_of_all(workers: Sequence[WorkerRow], fact: str) -> int | None:
    """Return the largest value of a number that all workers report; None if one of them does not."""
    values = [row.facts.get(fact) for row in workers if row.queues]
    numbers = [int(value) for value in values if isinstance(value, int)]
    return max(numbers) if numbers and len(numbers) == len(values) else None


def _cold_start_seconds(worker: WorkerRow) -> float:
    """Seconds in which a worker compiles the kernels that it lacks."""
    found = worker.facts.get("cold_start_seconds")
    return float(found) if isinstance(found, int | float) else 0.0


def _cores_per_job(worker: WorkerRow) -> int:
    """Return the cores for one job of a worker, if it reports them."""
    found = worker.facts.get("threads", worker.facts.get("cores"))
    cores = found if isinstance(found, int) and found > 0 else 1
    return max(1, cores // max(1, worker.slots))
