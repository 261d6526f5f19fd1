"""Where files and folders are, as the functions of the package take it."""

import os

PathLike = str | os.PathLike[str]
"""The path of a file or folder; a :class:`octasplat.runs.Run` is one, too."""
