"""The documentation, where ``mkdocs build --strict`` of the repository built its site into this package."""

import base64
import hashlib
import re
from functools import cache
from pathlib import Path

from fastapi import Request, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from octasplat.service.web.templating import render_page

SITE_FOLDER = Path(__file__).parent / "site"
_INLINE_SCRIPT = re.compile(r"<script(?![^>]*application/json)[^>]*>(.+?)</script>", re.DOTALL)


class DocumentationSite(StaticFiles):
    """The files of the site, whose pages may run the scripts that were built into them and no others.

    Where the site was not built, every address has a page that says where the documents are.
    """

    def __init__(self, folder: Path = SITE_FOLDER) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self.config_checked = True  # the folder need not be there
        self._folder = folder

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return the file."""
        if not (self._folder / "index.html").is_file():
            return render_page(
                Request(scope),
                "error.html",
                title="The documentation is not part of this installation",
                detail="It lies in the folder docs/ of the repository. There, mkdocs build --strict before "
                "the installation makes it a part. The API is described under API.",
            )
        response = await super().get_response(path, scope)
        response.headers["Cache-Control"] = "no-cache"
        response.headers["Content-Security-Policy"] = _content_security_policy(self._folder)
        return response


@cache
def _content_security_policy(folder: Path) -> str:
    """Return the content security policy of the site: its own files, and its inline scripts by digest."""
    scripts = {
        script
        for page in folder.rglob("*.html")
        for script in _INLINE_SCRIPT.findall(page.read_text(encoding="utf-8"))
    }
    digests = sorted(
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts
    )
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    return (
        f"default-src 'none'; script-src 'self' {allowed}; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; font-src 'self'; connect-src 'self'; worker-src 'self'; form-action 'self'; "
        "base-uri 'none'; frame-ancestors 'none'"
    )
