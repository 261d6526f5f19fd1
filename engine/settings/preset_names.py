"""Names of the presets; imports nothing heavy, so that a command line can offer them at once."""

from typing import Literal, get_args

PresetName = Literal["fast", "standard", "high", "redisplats"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
PRESETS_WITH_MATERIALS: tuple[PresetName, ...] = ("fast", "standard", "high")
"""Those with which materials can be learnt; ``redisplats`` has published settings for scenes without."""
