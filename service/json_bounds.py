"""Bodies of JSON that are small to send and long to read are refused by their text, before they are parsed.

Parsing, validating and listing the faults of a megabyte of empty lists takes a second of the event loop.
Counting its commas and brackets takes milliseconds, of another thread.
"""

import json
import re
from collections.abc import Mapping
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from octasplat.service.http_middleware import HttpMiddleware, is_file_content
from octasplat.service.problems import ProblemError
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool

MAX_VALUES = 50_000
MAX_MEMBERS = 512
MAX_DEPTH = 24
MAX_NUMBER_DIGITS = 400
"""More are no double, and reading them takes time by their square."""
_SMALL_BYTES = 1 << 12
"""Shorter bodies are counted at once, not in a thread."""
# Ends at the end of the text where nothing closes it, so that each character is looked at once.
_STRING = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)', re.DOTALL)
_LONG_NUMBER = b"0" * (MAX_NUMBER_DIGITS + 1)
_DIGITS_AS_ZEROS = bytes(ord("0") if each in b"0123456789" else ord(" ") for each in range(256))
"""A pattern would look at each digit hundreds of times, and lets no other thread run meanwhile."""
_SPACE = re.compile(r"[ \t\n\r]*")
_NOT_STRUCTURE = bytes(set(range(256)) - set(b"[]{},"))
_STARTS, _OBJECT_START, _ENDS = b"[{", ord("{"), b"]}"


class JsonBoundsMiddleware(HttpMiddleware):
    """Refuses bodies of JSON with too many values, members or levels.

    Args:
        app: behind it; its bodies are bounded in length before.
        more_values: values that are allowed by what addresses begin with, instead of :data:`MAX_VALUES`.
    """

    def __init__(self, app: ASGIApp, more_values: Mapping[str, int]) -> None:
        super().__init__(app)
        self._more_values = dict(more_values)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 422."""
        if is_file_content(scope) or "json" not in Headers(scope=scope).get("content-type", "").lower():
            await self._app(scope, receive, send)
            return
        pieces, is_complete = [], False
        while not is_complete:
            message = await receive()
            if message["type"] != "http.request":
                return  # whoever sent it is gone
            pieces.append(message.get("body", b""))
            is_complete = not message.get("more_body", False)
        body = b"".join(pieces)
        allowed = [most for prefix, most in self._more_values.items() if scope["path"].startswith(prefix)]
        max_values = max(allowed, default=MAX_VALUES)
        if len(body) <= _SMALL_BYTES:
            excess = find_excess(body, max_values)
        else:
            excess = await run_in_pool(ThreadPurpose.BODIES, find_excess, body, max_values)
        if excess is not None:
            code, detail = excess
            faults = [{"code": code, "detail": detail, "pointer": "#/"}]
            await ProblemError(422, "request", detail, errors=faults).response()(scope, receive, send)
            return

        async def receive_again() -> Message:
            nonlocal is_complete
            if not is_complete:
                return await receive()
            is_complete = False
            return {"type": "http.request", "body": body, "more_body": False}

        await self._app(scope, receive_again, send)


def find_excess(body: bytes, max_values: int = MAX_VALUES) -> tuple[str, str] | None:
    """Return the code and sentence of what is too much in a text of JSON; None where nothing is.

    Args:
        body: the text, which may be no JSON.
        max_values: most values within it, at any depth.
    """
    if json.detect_encoding(body) not in ("utf-8", "utf-8-sig"):
        return "encoding", "JSON is read in UTF-8 only."  # the parser takes others, whose brackets differ
    try:
        body.decode()
    except UnicodeDecodeError:
        more = "The body is no text in UTF-8, in which JSON is read; send it so, and not compressed."
        return "encoding", more
    too_many = ("too_many_values", f"The request has more than {max_values} values.")
    # Texts are cut out first, as brackets and commas within them are none.
    pieces, end = [], 0
    for number, found in enumerate(_STRING.finditer(body)):
        if number > 2 * max_values:  # each is a value or a name
            return too_many
        pieces.append(body[end : found.start()])
        end = found.end()
    rest = b" ".join([*pieces, body[end:]])
    if _LONG_NUMBER in rest.translate(_DIGITS_AS_ZEROS):
        return "too_long_number", f"A number has more than {MAX_NUMBER_DIGITS} digits."
    # Each value but the outermost one follows a comma or an opening bracket.
    structure = rest.translate(None, _NOT_STRUCTURE)
    if sum(structure.count(each) for each in (b",", b"[", b"{")) > max_values:
        return too_many
    room = [max_values]  # for further commas, in each container that is open
    for token in structure:
        if token in _STARTS:
            room.append(MAX_MEMBERS - 1 if token == _OBJECT_START else max_values)
            if len(room) > MAX_DEPTH + 1:
                return "too_deep", f"The request is nested deeper than {MAX_DEPTH} levels."
        elif token in _ENDS:
            # A text that closes more than it opens is left to the parser, which refuses it.
            if len(room) == 1:
                return None  # no JSON, as the parser says; any number of these may follow
            room.pop()
        else:
            room[-1] -= 1
            if room[-1] < 0:
                return "too_many_members", f"An object has more than {MAX_MEMBERS} members."
    return None


def parse_in_pieces(body: bytes) -> Any:
    """Return the value of a text of JSON; of lists in its outermost object each element is parsed by itself.

    The interpreter lets no other thread run while it parses one text.

    Raises:
        json.JSONDecodeError: it is no JSON.
    """
    text = body.decode("utf-8")
    decoder = json.JSONDecoder()
    found: dict[str, Any] = {}
    position, end = _skip(text, 0), len(text)
    if not text.startswith("{", position):
        return json.loads(text)
    position = _skip(text, position + 1)
    while not text.startswith("}", position):
        name, position = decoder.raw_decode(text, position)
        position = _skip(text, position)
        if not isinstance(name, str) or not text.startswith(":", position):
            raise json.JSONDecodeError("Expecting a name and ':'", text, position)
        position = _skip(text, position + 1)
        if text.startswith("[", position):
            found[name], position = _read_list(decoder, text, position + 1)
        else:
            found[name], position = decoder.raw_decode(text, position)
        position = _skip(text, position)
        position = _after_comma(text, position, "}")
    if _skip(text, position + 1) != end:
        raise json.JSONDecodeError("Extra data", text, position + 1)
    return found


def _read_list(decoder: json.JSONDecoder, text: str, position: int) -> tuple[list[Any], int]:
    """Return the elements of a list and where it ends; ``position`` is behind its bracket."""
    elements: list[Any] = []
    position = _skip(text, position)
    while not text.startswith("]", position):
        element, position = decoder.raw_decode(text, position)
        elements.append(element)
        position = _after_comma(text, _skip(text, position), "]")
    return elements, position + 1


def _after_comma(text: str, position: int, closing: str) -> int:
    """Return where the next element begins, or the closing bracket is."""
    if text.startswith(closing, position):
        return position
    after = _skip(text, position + 1)
    if not text.startswith(",", position) or text.startswith(closing, after):
        raise json.JSONDecodeError("Expecting ',' delimiter", text, position)
    return after


def _skip(text: str, position: int) -> int:
    """Return the position of the next character that is no white space."""
    found = _SPACE.match(text, position)
    assert found is not None
    return found.end()
