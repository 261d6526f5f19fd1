"""Route of the audit log."""

from fastapi import APIRouter, Request, Response

from octasplat.service.actions.audit import list_entries
from octasplat.service.auth import Admin
from octasplat.service.paging import Cursor, Limit, decode_number_cursor, set_next_link
from octasplat.service.routes import problem_responses
from octasplat.service.routes.response_headers import LINK, with_headers
from octasplat.service.schemas.audit import AuditPage, AuditView
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1/audit", tags=["service"])


@router.get("", responses={**with_headers(200, LINK), **problem_responses()})
async def list_audit_entries(
    _principal: Admin, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> AuditPage:  # fmt: skip
    """List requested changes, by whom and with what outcome, the newest first; for administrators.

    Single files of datasets are not listed, their commits are; of wrong tokens the first of each address.
    """
    part = await list_entries(service, before=decode_number_cursor(cursor), limit=limit)
    following = set_next_link(request, response, part.next_key)
    views = [AuditView.model_validate(row, from_attributes=True) for row in part.rows]
    return AuditPage(entries=views, next=following)
