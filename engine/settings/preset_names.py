"""Names of the presets; imports nothing heavy, so that a command line can offer them at once."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

PresetName = Literal["fast", "standard", "high", "redisplats"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
PRESETS_WITH_MATERIALS: tuple[PresetName, ...] = ("fast", "standard", "high")
"""Those with which materials can be learnt; ``redisplats`` has published settings for scenes without."""


@dataclass(frozen=True)
class PresetWords:
    """A preset in plain words: what it is called in a form, and what it is for."""

    title: str
    text: str


PRESET_WORDS: Mapping[PresetName, PresetWords] = {
    "fast": PresetWords("First look", "a first look, the fastest and less sharp than standard"),
    "standard": PresetWords("Standard", "the usual choice, sharp enough for most uses"),
    "high": PresetWords(
        "High detail",
        "for a final result: a little sharper than standard where photographs are many and sharp, slower and "
        "with more Gaussians",
    ),
    "redisplats": PresetWords(
        "As published",
        "the settings that the paper REdiSplats published, to compare with it; for a scene of your own, "
        "standard is better",
    ),
}
"""What each preset is for, as the form, the help and the documents say it."""
