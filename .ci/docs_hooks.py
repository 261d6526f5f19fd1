"""Hooks of MkDocs: links from docs/ to other files of the repository, which the site does not hold."""

import posixpath
import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]+)\]\((?P<target>(?!https?:|#|mailto:)[^)\s]+)\)")


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Write the place in the repository instead of a link that leads out of docs/."""
    folder = posixpath.dirname(page.file.src_uri)

    def outside(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join("docs", folder, match["target"].partition("#")[0]))
        if path.startswith("docs/"):
            return match[0]
        text = match["text"].strip("`")
        return f"`{path}`" if text in (path, posixpath.basename(path)) else f"{text} (`{path}`)"

    return _LINK.sub(outside, markdown)


def on_post_build(*, config: Any, **_: Any) -> None:
    """Remove what an English site never loads: maps for debuggers, and word splitters of other languages."""
    scripts = Path(config.site_dir) / "assets"
    for pattern in ("**/*.map", "javascripts/lunr/**/*.js"):
        for path in scripts.glob(pattern):
            path.unlink()
