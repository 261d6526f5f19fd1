"""What a job would take, before it is asked for."""

from fastapi import APIRouter

from service.auth import Writer
from service.limits import check_ceilings, estimate_job
from service.problems import Problem
from service.queue_facts import workers_of
from service.routes import problems
from service.routes.jobs import accepted_kind, resolved
from service.schemas.estimates import EstimateView, NewEstimate
from service.state import ServiceDep
from workers.queue.jobs import get_job
from workers.records.database import Connection
from workers.records.datasets import get_dataset, photograph_sizes
from workers.records.sizes import Sizes

router = APIRouter(prefix="/v1/estimates", tags=["jobs"])


@router.post("", responses=problems(404))
async def make_estimate(new: NewEstimate, who: Writer, service: ServiceDep) -> EstimateView:
    """Say what a job would take, without making it; options are checked as if it were made.

    Time and memory are right within a factor of two.
    """
    kind = accepted_kind(new.kind)
    options = resolved(kind, new.options)
    async with service.pool.connection() as connection:
        sizes = [Sizes(group.width_px, group.height_px, group.count) for group in new.photographs]
        sizes += await _sizes_of(connection, who.sees, new)
        workers = await workers_of(connection, new.queue, service.settings.stale_seconds)
    check_ceilings(kind, options, sizes, service.settings)
    return EstimateView(estimate=estimate_job(kind, options, sizes, workers))


async def _sizes_of(connection: Connection, owner: str | None, new: NewEstimate) -> list[Sizes]:
    """Sizes of the photographs of a dataset, or of the one that a job worked on; ``owner`` None sees all."""
    dataset_id = new.dataset_id
    if new.source_id is not None:
        job = await get_job(connection, new.source_id)
        if job is None or (owner is not None and job.owner != owner):
            detail = "There is no such job."
            raise Problem(422, "input", detail, errors=[{"pointer": "#/source_id", "detail": detail}])
        dataset_id = dataset_id or job.dataset_id
    if dataset_id is None:
        return []
    dataset = await get_dataset(connection, dataset_id)
    if dataset is None or (owner is not None and dataset.owner != owner):
        detail = "There is no such dataset."
        raise Problem(422, "input", detail, errors=[{"pointer": "#/dataset_id", "detail": detail}])
    return await photograph_sizes(connection, dataset_id)
