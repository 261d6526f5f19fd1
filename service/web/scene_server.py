"""Local server of the viewer for one scene, without jobs, database or sign-in."""

import json
import mimetypes
import os
import secrets
import shutil
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from octasplat.service.web.assets import STATIC_FOLDER
from octasplat.service.web.templating import PAGE_HEADERS, render_template

_LOCAL_HOSTS = frozenset({"127.0.0.1", "localhost"})
_PIECE_BYTES = 1 << 20
"""Of a file that is sent, at a time."""


@dataclass(frozen=True)
class ViewedScene:
    """Content of the viewer page.

    Attributes:
        name: its heading.
        ply: the scene as a file.
        cameras: as :func:`octasplat.service.web.cameras.viewer_cameras` returns them; without views, the
            page looks at the middle of the scene.
        q: squared radius of an opaque octagon in standard deviations; None for the usual one.
        background: ``black`` or ``white``.
        light: Radiance HDR map in which materials are shown to begin with; None shows harmonics.
        light_up: the direction in the world that is at the map's top.
    """

    name: str
    ply: Path
    cameras: Mapping[str, Any]
    q: float | None
    background: str
    light: Path | None = None
    light_up: tuple[float, float, float] = (0.0, 0.0, 1.0)


class SceneServer:
    """Serves the page of one scene to browsers of this machine, in a thread of its own.

    Page and scene lie under a random path, so that other users of the machine cannot find them.

    Args:
        scene: what to show.
        port: where; 0 takes a free one.
    """

    def __init__(self, scene: ViewedScene, port: int = 0) -> None:
        self._server = _SceneHttpServer(scene, port)
        self._thread = threading.Thread(target=self._server.serve_forever, name="scene-server", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Return the address of the page."""
        return f"http://127.0.0.1:{self._server.server_port}{self._server.page_path}"

    def close(self) -> None:
        """Stop the server and wait for its thread."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def wait(self) -> None:
        """Wait until somebody closes the server."""
        self._thread.join()


class _SceneHttpServer(ThreadingHTTPServer):
    # A connection that a browser keeps open does not hold up the end.
    daemon_threads = True

    def __init__(self, scene: ViewedScene, port: int) -> None:
        super().__init__(("127.0.0.1", port), _SceneHandler)
        self.scene = scene
        self.page_path = f"/{secrets.token_urlsafe(16)}/"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore browsers that disconnect early."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _SceneHandler(BaseHTTPRequestHandler):
    server: _SceneHttpServer

    def do_GET(self) -> None:
        host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        path = unquote(urlsplit(self.path).path)
        scene, page = self.server.scene, self.server.page_path
        if host not in _LOCAL_HOSTS:  # a page from elsewhere whose name leads here must not read the scene
            self.send_error(403)
        elif path == page:
            text = render_template(
                "viewer.html",
                name=scene.name,
                page=page,
                size_bytes=scene.ply.stat().st_size,
                q=scene.q,
                background=scene.background,
                light="" if scene.light is None else f"{page}light.hdr",
                up=json.dumps(scene.light_up),
            )
            self._send(text.encode(), "text/html; charset=utf-8", PAGE_HEADERS)
        elif path == f"{page}cameras.json":
            self._send(json.dumps(scene.cameras).encode(), "application/json")
        elif path == f"{page}scene.ply":
            self._send_file(scene.ply, "application/octet-stream")
        elif path == f"{page}light.hdr" and scene.light is not None:
            self._send_file(scene.light, "image/vnd.radiance")
        else:
            self._send_asset(path)

    def _send_asset(self, path: str) -> None:
        # Resolved before it is judged, as ``..`` or a link may lead out of the folder.
        file = (STATIC_FOLDER / path.removeprefix("/static/")).resolve()
        if (
            not path.startswith("/static/")
            or not file.is_relative_to(STATIC_FOLDER.resolve())
            or not file.is_file()
        ):
            self.send_error(404)
            return
        kind = "text/javascript" if file.suffix == ".js" else mimetypes.guess_type(file.name)[0]
        self._send_file(file, kind or "application/octet-stream")

    def _send(self, content: bytes, kind: str, headers: Mapping[str, str] | None = None) -> None:
        self._send_head(len(content), kind, headers)
        self.wfile.write(content)

    def _send_file(self, file: Path, kind: str) -> None:
        with file.open("rb") as handle:
            self._send_head(os.fstat(handle.fileno()).st_size, kind)
            shutil.copyfileobj(handle, self.wfile, _PIECE_BYTES)

    def _send_head(self, size_bytes: int, kind: str, headers: Mapping[str, str] | None = None) -> None:
        self.send_response(200)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(size_bytes),
            **(headers or {}),
        }.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        """Write no log of requests."""
