"""Names of the presets; imports nothing, so that a command line can offer them at once."""

from typing import Literal, get_args

PresetName = Literal["fast", "standard", "high", "paper"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
