"""Data folder of this machine, and the file in which ``octasplat serve`` publishes its address."""

import os
from pathlib import Path

import platformdirs

ADDRESS_FILE = "serve.json"
"""In the data folder while ``octasplat serve`` runs: where the service is."""
TOKEN_FILE = "token"  # noqa: S105 - a name
"""In the data folder: the token that ``octasplat serve`` made for itself, readable by its user only."""


def default_data_folder() -> Path:
    """Return the folder of this machine; root's home is shut to the database's user, so root has another."""
    if os.geteuid() == 0:
        return Path("/var/lib/octasplat")
    return platformdirs.user_data_path("octasplat")
