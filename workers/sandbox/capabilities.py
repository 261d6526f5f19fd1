"""Isolation features of this machine, and the reasons for missing ones."""

import logging
import os

from octasplat.workers.sandbox.landlock import landlock_version
from octasplat.workers.sandbox.linux import IS_LINUX
from octasplat.workers.sandbox.seccomp import has_seccomp

logger = logging.getLogger(__name__)


def sandbox_capabilities() -> dict[str, str | None]:
    """Return, by subject, what isolates jobs and model readers on this machine; None for nothing."""
    is_filtered, version = has_seccomp(), landlock_version()
    return {
        "environment": "scrubbed",
        "memory_of_others": "not dumpable" if IS_LINUX else None,
        "network": "seccomp" if is_filtered else None,
        "calls": "seccomp" if is_filtered else None,
        "folders": f"landlock {version}" if version else None,
        "signals": f"landlock {version}" if version >= 6 else None,
        "processes": "counted" if os.geteuid() == 0 else "counted, rlimit",
        "memory": "measured, rlimit",
        "time_of_readers": "rlimit",
    }


def log_missing_capabilities() -> None:
    """Log in one line which isolation features are missing here."""
    lacking = [
        subject.replace("_", " ") for subject, means in sandbox_capabilities().items() if means is None
    ]
    if lacking:
        logger.warning(
            "nothing keeps the programs of jobs from these here: %s; the kernel takes no part in it, so "
            "trust whoever sends photographs, or run workers in containers",
            ", ".join(lacking),
        )
