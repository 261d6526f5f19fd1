"""Isolation features of this machine, and the reasons for missing ones."""

import logging
import os

from octasplat.workers.sandbox.landlock import landlock_version
from octasplat.workers.sandbox.linux import IS_LINUX
from octasplat.workers.sandbox.seccomp import has_seccomp

logger = logging.getLogger(__name__)


def sandbox_capabilities(job_uids: range | None = None) -> dict[str, str | None]:
    """Return, by subject, what isolates jobs and model readers on this machine; None for nothing.

    Args:
        job_uids: users that jobs run as, see :mod:`octasplat.workers.sandbox.job_users`.
    """
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
        "leftovers": "subreaper" if IS_LINUX else None,
        "user_of_jobs": _job_user(job_uids),
    }


def _job_user(job_uids: range | None) -> str:
    if job_uids is not None:
        return f"one of its own for each job ({job_uids[0]}-{job_uids[-1]})"
    return "root, as the service" if os.geteuid() == 0 else "that of the service"


def log_missing_capabilities(job_uids: range | None) -> None:
    """Log in one line which isolation features are missing here, and in another where jobs run as root.

    Args:
        job_uids: users that jobs run as.
    """
    if os.geteuid() == 0 and job_uids is None:
        logger.warning(
            "octasplat runs as root, and so do the programs of jobs and readers of models: run it as a user "
            "of its own (systemd: DynamicUser=yes), or name users for jobs by OCTASPLAT_JOB_UIDS, such as "
            "200000-200063"
        )
    lacking = [
        subject.replace("_", " ") for subject, means in sandbox_capabilities().items() if means is None
    ]
    if lacking:
        logger.warning(
            "nothing keeps the programs of jobs from these here: %s; the kernel takes no part in it, so "
            "trust whoever sends photographs, or run workers in containers",
            ", ".join(lacking),
        )
