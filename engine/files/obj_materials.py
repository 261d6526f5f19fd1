"""The materials of an OBJ: its MTL files, as far as they are understood.

The keys of http://paulbourke.net/dataformats/mtl/ with the extension for physically based rendering (``Pr``,
``Pm``, ``Pc``, ``norm``) that modelling programs write. Colors are taken as linear, as Blender writes them.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.geometry.mesh_material import MeshMaterial, resolve_image

MAX_BYTES = 64 << 20
_LIBRARY_NAMES = re.compile(r"\S.*?\.mtl(?=\s|$)|\S+", re.IGNORECASE)
"""Names in a row: each up to its suffix, with the spaces in it, or a word without one."""
UNKNOWN_RGB_LINEAR = (0.6, 0.6, 0.6)
"""Of a material that states no color, or of which nothing is known."""
NUMBERS = {"Ns", "Ni", "d", "Tr", "Pr", "Pm", "Pc", "Pcr", "illum"}
COLORS = {"Kd", "Ke"}
IMAGES = {
    "map_Kd": "texture", "map_Ke": "emission_texture", "norm": "normal_texture", "map_d": "opacity_texture",
}  # fmt: skip
IGNORED_KEYS = {"Ka", "Ks", "Tf", "Ns", "newmtl", "map_Ka", "map_Ks"}
"""What older programs write into every file, and what has no counterpart."""
IMAGE_OPTIONS = {
    "-s": ("1", "1"), "-o": ("0", "0"), "-t": ("0", "0"), "-mm": ("0", "1"), "-bm": ("1",),
    "-clamp": ("off",), "-cc": ("off",),
}  # fmt: skip
"""Options of images, with the values that ask for nothing; a third number of a place is its depth."""
IGNORED_OPTIONS = {"-blendu", "-blendv", "-boost", "-texres"}
"""Options of how an image is made smaller, which is not done here."""
EXTENSION_KEYS = {"Pr", "Pm", "Ps", "Pc", "Pcr", "aniso", "anisor"}
"""Keys that programs write with the extension, and not without it."""
GLASS_ILLUM_MODELS = (4, 6, 7, 9)
"""Illumination models with refraction or with transparency by ray tracing."""


def read_mtl(obj: Path, names: Sequence[str]) -> dict[str, MeshMaterial]:
    """Return the materials by name of the MTL files that an OBJ names; files that are not there have none.

    Raises:
        SceneFileError: a file cannot be read, a number is none, or an image is missing.
    """
    materials: dict[str, MeshMaterial] = {}
    # the first file that has a material counts
    for name in reversed(names):
        path = _library_path(obj, name)
        if path is None:
            continue
        try:
            if path.stat().st_size > MAX_BYTES:
                raise SceneFileError(f"{path}: is larger than {MAX_BYTES >> 20} MB, which no MTL needs.")
            text = path.read_text(encoding="utf-8-sig", errors="replace")
        except OSError as error:
            raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
        for entry in _parse_entries(text):
            materials[entry["newmtl"]] = _parse_material(path, entry)
    return materials


def library_names(obj: Path, lines: Sequence[str]) -> tuple[str, ...]:
    """Return the MTL files that lines ``mtllib`` of an OBJ name, one or several a line."""
    names: list[str] = []
    for line in lines:
        several = _LIBRARY_NAMES.findall(line)
        names += [line] if _library_path(obj, line) is not None else several
    return tuple(names)


def missing_libraries(obj: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return those of the MTL files that an OBJ names that :func:`read_mtl` does not find."""
    return tuple(name for name in names if _library_path(obj, name) is None)


def _library_path(obj: Path, name: str) -> Path | None:
    """Return an MTL file that an OBJ names; None where it is not there."""
    folder = obj.parent.resolve()
    path = (folder / name.replace("\\", "/")).resolve()
    # Nothing outside the folder of the OBJ is read, whatever it names.
    return path if path.is_relative_to(folder) and path.is_file() else None


def _parse_entries(text: str) -> list[dict[str, str]]:
    entries: list[dict[str, str]] = []
    for line in text.splitlines():
        words = line.split("#", 1)[0].strip().split(maxsplit=1)
        if len(words) == 2 and words[0] == "newmtl":
            entries.append({"newmtl": words[1].strip()})
        elif len(words) == 2 and entries:
            entries[-1][words[0]] = words[1].strip()
    return entries


def _parse_material(path: Path, entry: dict[str, str]) -> MeshMaterial:
    numbers = {key: _parse_numbers(path, key, entry[key], 1)[0] for key in sorted(NUMBERS & set(entry))}
    colors: dict[str, tuple[float, float, float]] = {}
    for key in sorted(COLORS & set(entry)):
        red, green, blue = _parse_numbers(path, key, entry[key], 3)
        colors[key] = (red, green, blue)
    found: dict[str, Any] = {}
    passed_over: list[str] = []
    for key, field in IMAGES.items():
        if key in entry:
            options, name = _image_options(entry[key])
            found[field] = resolve_image(path, name)
            if key == "norm" and "-bm" in options:
                words = " ".join(options.pop("-bm"))
                found["normal_scale"] = _parse_numbers(path, "-bm of norm", words, 1)[0]
            passed_over += [f"{option} of {key}" for option, words in options.items() if _says(option, words)]
    if "texture" in found:
        colors["Kd"] = (1.0, 1.0, 1.0)  # programs leave a grey here that the image is not meant to have
    # Images are multiplied by the color, which may be missing or black beside them.
    if "emission_texture" in found and not any(colors.get("Ke", ())):
        colors["Ke"] = (1.0, 1.0, 1.0)
    opacity = numbers.get("d", 1.0 - numbers.get("Tr", 0.0))  # Tr is transparency
    clear = int(numbers.get("illum", 0)) in GLASS_ILLUM_MODELS and ("Ni" in numbers or opacity < 1.0)
    # The light that glass lets through. With the extension Kd is its color, and Tf how much of it is glass.
    if clear and "Tf" in entry and not EXTENSION_KEYS & set(entry):
        red, green, blue = _parse_numbers(path, "Tf", entry["Tf"], 3)
        if red or green or blue:
            colors["Kd"] = (red, green, blue)
    known = NUMBERS | COLORS | set(IMAGES) | IGNORED_KEYS
    passed_over += [key for key in entry if key not in known]
    return MeshMaterial(
        entry["newmtl"],
        colors.get("Kd", UNKNOWN_RGB_LINEAR),
        metallic=min(max(numbers.get("Pm", 0.0), 0.0), 1.0),
        roughness=min(max(numbers.get("Pr", 1.0), 0.0), 1.0),
        emission_linear=colors.get("Ke", (0.0, 0.0, 0.0)),
        transmission=float(clear),
        ior=numbers.get("Ni", 1.5) if numbers.get("Ni", 1.5) >= 1.0 else 1.5,
        clear_coat=min(max(numbers.get("Pc", 0.0), 0.0), 1.0),
        clear_coat_roughness=min(max(numbers.get("Pcr", 0.0), 0.0), 1.0),
        opacity=1.0 if clear else min(max(opacity, 0.0), 1.0),
        unsupported=tuple(passed_over),
        **found,
    )


def _parse_numbers(path: Path, key: str, text: str, count: int) -> tuple[float, ...]:
    words = text.split()
    if count == 3 and len(words) == 1:
        words *= 3  # one number is gray
    try:
        values = tuple(float(word) for word in words[:count])
    except ValueError:
        values = ()
    if len(values) < count or not all(math.isfinite(value) for value in values):
        raise SceneFileError(f"{path}: {key} holds something that is no number ({text[:40]}).")
    return values


def _image_options(text: str) -> tuple[dict[str, list[str]], str]:
    """Return the options of an image and its name, of a text such as ``-bm 0.3 wood bark.png``."""
    words = text.split()
    options: dict[str, list[str]] = {}
    k = 0
    while k < len(words) and words[k].startswith("-") and len(words[k]) > 1:
        first = k = k + 1
        while k < len(words) - 1 and (_is_number(words[k]) or words[k] in ("on", "off")):
            k += 1
        options[words[first - 1]] = words[first:k]
    return options, " ".join(words[k:])


def _says(option: str, words: Sequence[str]) -> bool:
    """Return whether an option of an image asks for anything else than is done without it."""
    if option not in IMAGE_OPTIONS:
        return option not in IGNORED_OPTIONS
    usual = IMAGE_OPTIONS[option]
    return any(
        (float(word) != float(default)) if _is_number(word) and _is_number(default) else word != default
        for word, default in zip(words, usual, strict=False)
    )


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
