"""What OpenImageIO says of files that it cannot read or write."""

from typing import Any


def image_message(source: Any) -> str:
    """Return the last error of OpenImageIO, or of one of its readers or writers; empty where there is none.

    Args:
        source: the module, or a reader or writer.
    """
    try:
        return str(source.geterror())
    except UnicodeDecodeError:  # it quotes bytes of a damaged file
        return "its header is damaged"
