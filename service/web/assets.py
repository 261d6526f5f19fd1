"""Static files: scripts, styles and third-party modules."""

from pathlib import Path

from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

STATIC_FOLDER = Path(__file__).parent / "static"


class StaticAssets(StaticFiles):
    """Files that a browser may cache if it revalidates them."""

    def __init__(self) -> None:
        super().__init__(directory=STATIC_FOLDER)

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a static file with its cache and security headers."""
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        # Workers have a policy of their own, which comes with their file.
        response.headers["Content-Security-Policy"] = (
            "default-src 'none'; script-src 'self'; connect-src 'self'"
        )
        return response
