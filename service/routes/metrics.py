"""Route of the Prometheus metrics; its token goes into `authorization` of the settings of Prometheus."""

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST

from octasplat.service.actions.system import render_metrics
from octasplat.service.auth import Monitor
from octasplat.service.routes import problem_responses
from octasplat.service.state import ServiceDep

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **problem_responses()},
    response_class=Response,
)
async def get_metrics(_principal: Monitor, service: ServiceDep) -> Response:
    """Return the metrics of the service in the Prometheus format.

    They are of all owners, so a token with the scope `metrics` or `admin` is needed.
    """
    text = await render_metrics(service)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST, "Cache-Control": "no-store"})
