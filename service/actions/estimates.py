"""Estimates of a job's cost before it is submitted."""

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.cost_model import Estimate
from octasplat.service.actions.validation import input_problem, resolve_options, validate_kind
from octasplat.service.auth import Principal
from octasplat.service.job_limits import check_job_limits, estimate_job
from octasplat.service.queue_workers import live_workers_of_queue
from octasplat.service.schemas.estimates import NewEstimate
from octasplat.service.state import Service
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import get_dataset, photograph_sizes
from octasplat.workers.queue.jobs import get_job


async def estimate(service: Service, principal: Principal, new: NewEstimate) -> Estimate | None:
    """Return the estimate of a job, validated as a submission is; None where it is unknown.

    Raises:
        ProblemError: 422.
    """
    kind = validate_kind(new.kind)
    options = (await resolve_options(kind, new.options)).complete
    async with service.pool.connection() as connection:
        sizes = [ImageSizes(group.width_px, group.height_px, group.count) for group in new.photographs]
        sizes += await _sizes_of(connection, principal, new)
        workers = await live_workers_of_queue(connection, new.queue, service.settings.stale_seconds)
    check_job_limits(kind, options, sizes, service.settings)
    return estimate_job(kind, options, sizes, workers)


async def _sizes_of(connection: Connection, principal: Principal, new: NewEstimate) -> list[ImageSizes]:
    """Return the sizes of the photographs of a dataset, or of the one that a job worked on."""
    dataset_id = new.dataset_id
    if new.source_id is not None:
        job = await get_job(connection, new.source_id)
        if job is None or not principal.may_see(job.owner):
            raise input_problem("source_id", "There is no such job.")
        dataset_id = dataset_id or job.dataset_id
    if dataset_id is None:
        return []
    dataset = await get_dataset(connection, dataset_id)
    if dataset is None or not principal.may_see(dataset.owner):
        raise input_problem("dataset_id", "There is no such dataset.")
    return await photograph_sizes(connection, dataset_id)
