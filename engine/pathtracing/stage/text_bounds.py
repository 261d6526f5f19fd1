"""Bounds of a stage's text, checked before it is parsed.

The parser of TOML takes time and memory that grow with the square of the parts of a dotted key, so a text
from others is looked at first, in one pass.
"""

import re

MAX_TEXT_CHARACTERS = 256 << 10
MAX_KEY_PARTS = 8
MAX_BRACKET_DEPTH = 24
MAX_ELEMENTS = 20_000
"""Keys, values and tables together, and the dots of keys and numbers."""

_STRINGS_AND_COMMENTS = re.compile(
    r'"""(?:[^"\\]++|\\.|"(?!""))*+(?:""")?'
    r"|'''(?:[^']++|'(?!''))*+(?:''')?"
    r'|"(?:[^"\\\n]++|\\[^\n])*+"?'
    r"|'[^'\n]*+'?"
    r"|\#[^\n]*+",
    re.DOTALL,
)
"""What brackets and dots mean nothing in; each matches to the end where nothing closes it, so that no text is
looked at twice."""
_WITHOUT_STRUCTURE = re.compile(r"[^.=,\[\]{}\n]+")
_LONG_KEY = re.compile(rf"\.{{{MAX_KEY_PARTS}}}")


def check_stage_text(text: str) -> None:
    """Refuse a text that would take long to parse.

    Raises:
        ValueError: it is too long, nested too deep, or has a key of too many parts or too many elements.
    """
    if len(text) > MAX_TEXT_CHARACTERS:
        raise ValueError(f"the stage has more than {MAX_TEXT_CHARACTERS} characters; send it as an object")
    structure = _WITHOUT_STRUCTURE.sub("", _STRINGS_AND_COMMENTS.sub("", text))
    if _LONG_KEY.search(structure):
        raise ValueError(f"a key of the stage has more than {MAX_KEY_PARTS} parts with dots between them")
    if len(structure) - structure.count("\n") > MAX_ELEMENTS:
        raise ValueError(f"the stage has more than {MAX_ELEMENTS} keys, values and tables")
    depth = 0
    for character in structure:
        depth += (character in "[{") - (character in "]}")
        if depth > MAX_BRACKET_DEPTH:
            raise ValueError(f"the stage has brackets nested deeper than {MAX_BRACKET_DEPTH}")
