"""Check of the lines of COLMAP's text files, for models that COLMAP's own reader refuses.

COLMAP's message names the failed check in its code, not the line.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

_NUMERIC_FIELDS = {
    "cameras": slice(4, None),
    "frames": slice(2, 9),
    "images": slice(1, 8),
    "points3D": slice(1, 4),
}
"""Where a line holds the numbers that must be finite."""


def find_text_model_error(folder: Path) -> str | None:
    """Return a sentence on the first invalid number of a text model, with its file, line and image.

    Args:
        folder: of the model.

    Returns:
        The sentence, or None where every camera, pose and point has finite numbers.
    """
    names = {parts[0]: " ".join(parts[9:]) for _, parts in _lines(folder / "images.txt") if len(parts) > 9}
    for part, place in _NUMERIC_FIELDS.items():
        path = folder / f"{part}.txt"
        for number, parts in _lines(path):
            fault = _find_invalid_number(parts[place])
            if fault is None:
                continue
            whose, remedy = _describe_line(part, parts, names)
            return f"{path} holds {fault} in {whose} (line {number}); {remedy}."
    return None


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the fields of each line, without the observations of images."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8", errors="replace") as lines:
        numbered = enumerate(lines, start=1)
        for number, line in numbered:
            if not line.strip() or line.startswith("#"):
                continue
            yield number, line.split()
            if path.stem == "images":
                next(numbered, None)  # it may be empty


def _find_invalid_number(texts: Sequence[str]) -> str | None:
    for text in texts:
        try:
            if math.isfinite(float(text)):
                continue
        except ValueError:
            pass
        return f"{text[:20]!r} where a finite number belongs"
    return None


def _describe_line(part: str, parts: list[str], names: dict[str, str]) -> tuple[str, str]:
    """Return what a line describes, and what the user can do about it."""
    if part == "cameras":
        return f"camera {parts[0]}", "mend the line or run COLMAP again"
    if part == "points3D":
        return f"point {parts[0]}", "remove the line or run COLMAP again"
    ids = parts[0:1] if part == "images" else parts[12::3]
    whose = " and ".join(names.get(each, f"image {each}") for each in ids) or f"frame {parts[0]}"
    return f"the pose of {whose}", "run COLMAP again or remove the image"
