"""Parts of pages that programs write: between two comments, in a page that people write."""


def marks(name: str, program: str) -> tuple[str, str]:
    """Return the comments that a part stands between.

    Args:
        name: of the part.
        program: module that writes it, with the option that lets it write.
    """
    return f"<!-- {name}: by python -m {program} -->", f"<!-- end of {name} -->"


def has_part(text: str, name: str, program: str) -> bool:
    """Return whether a page has such a part."""
    begin, end = marks(name, program)
    return end in text.partition(begin)[2]


def with_part(text: str, name: str, program: str, part: str, *, page: str) -> str:
    """Return the text of a page with one of its parts made anew.

    Args:
        text: of the whole page.
        name: of the part.
        program: see :func:`marks`.
        part: what is to stand there.
        page: name of the page, for the complaint.

    Raises:
        SystemExit: the page has no such part.
    """
    begin, end = marks(name, program)
    if not has_part(text, name, program):
        raise SystemExit(f"{page} has no part between '{begin}' and '{end}'.")
    before, _, rest = text.partition(begin)
    return f"{before}{begin}\n\n{part}\n\n{end}{rest.partition(end)[2]}"
