"""Names of the presets; imports nothing, so that a command line can offer them at once."""

from typing import Literal, get_args

PresetName = Literal["fast", "standard", "high", "paper"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
PRESETS_WITH_MATERIALS: tuple[PresetName, ...] = ("fast", "standard", "high")
"""Those with which materials can be learnt; ``paper`` has published settings for scenes without."""
