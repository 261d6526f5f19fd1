"""Route that estimates a job before it is submitted."""

from fastapi import APIRouter

from octasplat.service.actions.estimates import estimate
from octasplat.service.auth import Reader
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IdempotencyKey
from octasplat.service.schemas.estimates import EstimateView, NewEstimate
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1/estimates", tags=["jobs"])


@router.post("", responses=problem_responses(404))
async def make_estimate(
    new: NewEstimate, principal: Reader, service: ServiceDep, _key: IdempotencyKey = None
) -> EstimateView:
    """Estimate a job without creating it; options are validated as in a submission.

    Time and memory are right within a factor of two.
    """
    return EstimateView(estimate=await estimate(service, principal, new))
