"""The documentation in the service: its site where it was built, else a page that says where it is."""

import re
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from octasplat.service.web.documentation import DocumentationSite

PAGE = """<!doctype html><html><head><title>Guide</title><script>document.title = "run"</script>
<script id="config" type="application/json">{"search": true}</script>
<script src="assets/site.js"></script></head>
</html>
"""


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


async def get(folder: Path, path: str) -> httpx.Response:
    """Return the answer of an application that serves the site in a folder."""
    app = FastAPI()
    app.mount("/documentation", DocumentationSite(folder))
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://test", follow_redirects=True) as http:
        return await http.get(path)


@pytest.mark.anyio
async def test_site_is_served_with_its_own_scripts_only(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text(PAGE, encoding="utf-8")
    (tmp_path / "assets" / "site.js").write_text("1", encoding="utf-8")
    for path in ("/documentation", "/documentation/", "/documentation/index.html"):
        answer = await get(tmp_path, path)
        assert answer.status_code == 200 and "Guide" in answer.text
    policy = answer.headers["content-security-policy"]
    assert len(re.findall("'sha256-[^']+'", policy)) == 1 and "default-src 'none'" in policy
    assert "script-src 'self' 'unsafe-inline'" not in policy
    assert (await get(tmp_path, "/documentation/assets/site.js")).text == "1"
    assert (await get(tmp_path, "/documentation/../../secret")).status_code == 404


@pytest.mark.anyio
async def test_page_says_where_the_documents_are_without_a_site(tmp_path: Path) -> None:
    answer = await get(tmp_path / "nothing", "/documentation/")
    assert answer.status_code == 200 and "docs/ of the repository" in answer.text
