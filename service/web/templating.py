"""Templates, and the headers of every page."""

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse

from octasplat.engine import __version__
from octasplat.service.auth import Principal, session_secret
from octasplat.service.web import formatting
from octasplat.workers.client.short_ids import short_id

PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        "media-src 'self'; "
        "connect-src 'self'; worker-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}
STATE_LABELS = {
    "queued": "Queued",
    "running": "Running",
    "canceling": "Stopping",
    "succeeded": "Done",
    "failed": "Failed",
    "canceled": "Cancelled",
}


def render_page(
    request: Request,
    template: str,
    principal: Principal | None = None,
    *,
    status: int = 200,
    **values: object,
) -> HTMLResponse:
    """Return a rendered template.

    Args:
        request: what it answers.
        template: file in ``templates/``.
        principal: asks; None where nobody has signed in.
        status: of the answer.
        values: what the template shows.
    """
    text = render_template(
        template,
        principal=principal,
        signed_in=session_secret(request) is not None,
        path=request.url.path,
        version=__version__,
        **values,
    )
    return HTMLResponse(text, status, headers=PAGE_HEADERS)


def render_template(template: str, **values: object) -> str:
    """Return the text of a file in ``templates/`` that shows ``values``."""
    text: str = _jinja_environment().get_template(template).render(**values)
    return text


@cache
def _jinja_environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=PackageLoader("octasplat.service.web"),
        autoescape=select_autoescape(["html"]),
        # A name that a template gets wrong is an error, and no empty place.
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        size=formatting.format_size,
        duration=formatting.format_duration,
        thousands=formatting.format_thousands,
        ago=formatting.format_age,
        short=short_id,
        flat=flatten_settings,
        words=lambda name: str(name).replace("_", " "),
    )
    environment.globals["state_words"] = STATE_LABELS
    return environment


def flatten_settings(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return nested settings as dotted names and short texts."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += flatten_settings(value, f"{prefix}{key}.")
        elif isinstance(value, list) and all(isinstance(item, str) for item in value):
            rows.append((f"{prefix}{key}", ", ".join(value)))
        else:
            text = "–" if value is None else value if isinstance(value, str) else json.dumps(value)
            rows.append((f"{prefix}{key}", text))
    return rows
