"""The materials of an OBJ: its MTL files, as far as they are understood.

The keys of http://paulbourke.net/dataformats/mtl/ with the extension for physically based rendering (``Pr``,
``Pm``, ``Pc``, ``norm``) that modelling programs write. Colors are taken as linear, as Blender writes them.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.geometry.mesh_material import MeshMaterial, resolve_image

MAX_BYTES = 64 << 20
NUMBERS = {"Ns", "Ni", "d", "Tr", "Pr", "Pm", "Pc", "Pcr", "illum"}
COLORS = {"Kd", "Ke"}
IMAGES = {
    "map_Kd": "texture", "map_Ke": "emission_texture", "norm": "normal_texture", "map_d": "opacity_texture",
}  # fmt: skip
IGNORED_KEYS = {"Ka", "Ks", "Tf", "Ns", "newmtl", "map_Ka", "map_Ks"}
"""What older programs write into every file, and what has no counterpart."""
GLASS_ILLUM_MODELS = (4, 6, 7, 9)
"""Illumination models with refraction or with transparency by ray tracing."""


def read_mtl(obj: Path, names: Sequence[str]) -> dict[str, MeshMaterial]:
    """Return the materials by name of the MTL files that an OBJ names; files that are not there have none.

    Raises:
        SceneFileError: a file cannot be read, a number is none, or an image is missing.
    """
    materials: dict[str, MeshMaterial] = {}
    folder = obj.parent.resolve()
    for name in names:
        path = (folder / name.replace("\\", "/")).resolve()
        # Nothing outside the folder of the OBJ is read, whatever it names.
        if not (path.is_relative_to(folder) and path.is_file()):
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
    for key, field in IMAGES.items():
        if key in entry:
            found[field] = resolve_image(path, _file_name(entry[key]))
    if "texture" in found:
        colors["Kd"] = (1.0, 1.0, 1.0)  # programs leave a grey here that the image is not meant to have
    # Images are multiplied by the color, which may be missing or black beside them.
    if "emission_texture" in found and not any(colors.get("Ke", ())):
        colors["Ke"] = (1.0, 1.0, 1.0)
    opacity = numbers.get("d", 1.0 - numbers.get("Tr", 0.0))  # Tr is transparency
    clear = int(numbers.get("illum", 0)) in GLASS_ILLUM_MODELS and ("Ni" in numbers or opacity < 1.0)
    known = NUMBERS | COLORS | set(IMAGES) | IGNORED_KEYS
    passed_over = [key for key in entry if key not in known]
    return MeshMaterial(
        entry["newmtl"],
        colors.get("Kd", (0.6, 0.6, 0.6)),
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


def _file_name(text: str) -> str:
    """Return the name of an image behind its options, such as ``-bm 0.3 wood bark.png``."""
    words = text.split()
    k = 0
    while k < len(words) and words[k].startswith("-") and len(words[k]) > 1:
        k += 1
        while k < len(words) - 1 and (_is_number(words[k]) or words[k] in ("on", "off")):
            k += 1
    return " ".join(words[k:])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
