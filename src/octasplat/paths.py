"""Types of paths that the functions of the package accept."""

import os

PathLike = str | os.PathLike[str]
"""The path of a file or folder; a :class:`octasplat.runs.Run` is one, too."""
