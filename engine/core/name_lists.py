"""Lists of names in sentences: the first few of them."""

from collections.abc import Iterable

SHOWN_NAMES = 3


def name_list(names: Iterable[str], most: int = SHOWN_NAMES) -> str:
    """Return the first ``most`` names, and whether there are more.

    >>> name_list(["a.jpg", "b.jpg", "c.jpg", "d.jpg"]), name_list(["a.jpg"])
    ('a.jpg, b.jpg, c.jpg, ...', 'a.jpg')
    """
    names = list(names)
    shown = ", ".join(name if name.isprintable() else ascii(name) for name in names[:most])
    return shown + (", ..." if len(names) > most else "")
