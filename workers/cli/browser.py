"""Opening of a signed-in browser."""

import os
import sys
import tempfile
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from octasplat.workers.client.api import Api

_PAGE = """<!doctype html>
<meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={link}"><title>octasplat</title>
"""
_PAGE_OPEN_SECONDS = 10.0


def has_display() -> bool:
    """Return whether there is a display to open a browser on."""
    found = sys.platform == "darwin" or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
    return found and sys.stdout.isatty()


def sign_in_link(api: "Api") -> str:
    """Return a link that signs a browser in, once, within five minutes.

    Raises:
        ServiceError: the service does not make one.
        ServiceUnreachableError: nobody answers.
    """
    return api.address + str(api.post("/v1/sign-in-links")["path"])


def open_signed_in(api: "Api") -> bool:
    """Open the page of a service in a browser; return False where no browser can be started.

    The link goes by way of a file that only this user reads: whoever is on the machine sees what programs
    are started with.
    """
    link = sign_in_link(api)
    with tempfile.TemporaryDirectory(prefix="octasplat-open-") as folder:  # 0700
        path = Path(folder) / "open.html"
        path.write_text(_PAGE.format(link=link), encoding="ascii")
        if not webbrowser.open(path.as_uri()):
            return False
        time.sleep(_PAGE_OPEN_SECONDS)  # the browser reads the file after it has started
        return True
