"""Builds a stage of docker/Dockerfile in a chroot over this Debian and runs its command as its user.

What docker does with an instruction, this does by hand: RUN in the shell of the stage, COPY from the
repository, ENV, WORKDIR, USER, ENTRYPOINT and CMD as they say. The image below is this machine's system, with
nothing of it writable, instead of ``python:3.12-slim-bookworm``.
"""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from tests.docker.test_docker_files import ROOT, instructions

KEPT = re.compile(r"PIP_\w+|SSL_CERT_\w+|https?_proxy|no_proxy", re.IGNORECASE)
"""How this machine reaches the network."""


def missing_requirement() -> str | None:
    """Why there can be no such chroot here, or None."""
    if os.geteuid() != 0:
        return "a chroot needs root"
    release = Path("/etc/os-release")
    if not release.exists() or "bookworm" not in release.read_text():
        return "the images are made of Debian 12, which this is not"
    return None


@dataclass
class ChrootImage:
    """A stage that was built.

    Attributes:
        root: the file system.
        environment: what ENV said.
        folder: the last WORKDIR.
        user: the last USER.
        command: ENTRYPOINT and CMD.
        health: the command of HEALTHCHECK.
        shell: for RUN.
    """

    root: Path
    environment: dict[str, str] = field(default_factory=dict)
    folder: str = "/"
    user: str = "0"
    entry: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    health: list[str] = field(default_factory=list)
    shell: list[str] = field(default_factory=lambda: ["/bin/sh", "-c"])

    def wrapped(self, *command: str, user: str | None = None) -> list[str]:
        """That command as it runs in a container of this image, without any capability."""
        who = user if user is not None else self.user
        drop = [
            "setpriv",
            f"--reuid={who}",
            f"--regid={who}",
            "--clear-groups",
            "--no-new-privs",
            "--bounding-set=-all",
        ]
        inside = ["sh", "-c", 'cd "$0" && exec "$@"', self.folder, *command]
        return ["chroot", str(self.root), *(drop if who != "0" else []), *inside]

    def start(self, *command: str, **settings: str) -> "subprocess.Popen[bytes]":
        """Start a container's first process: the image's own command, or another one."""
        alone = ["unshare", "--pid", "--fork", f"--mount-proc={self.root / 'proc'}", "--kill-child"]
        log = (self.root.parent / "log").open("ab")
        with log:
            return subprocess.Popen(
                [*alone, *self.wrapped(*self.entry, *(command or self.command))],
                env={**self.environment, **settings}, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    @staticmethod
    def stop(process: "subprocess.Popen[bytes]") -> int:
        """Ask a container to end, as docker does; returns its exit code."""
        for first in psutil.Process(process.pid).children() if process.poll() is None else ():
            first.terminate()
        return process.wait(60)

    @staticmethod
    def kill(process: "subprocess.Popen[bytes]") -> None:
        """End a container at once."""
        if process.poll() is None:
            for first in psutil.Process(process.pid).children():
                first.kill()
            process.wait(60)

    def log(self) -> str:
        """What its processes said."""
        return (self.root.parent / "log").read_text()

    def take(self, word: str, rest: str, arguments: Mapping[str, str]) -> None:
        """Follow one instruction."""
        if word == "ENV":
            for pair in rest.split():
                name, _, value = pair.partition("=")
                self.environment[name] = value.replace("$PATH", self.environment["PATH"])
        elif word == "WORKDIR":
            self.folder = rest
            (self.root / rest.lstrip("/")).mkdir(parents=True, exist_ok=True)
        elif word == "USER":
            self.user = rest
        elif word in ("ENTRYPOINT", "CMD"):
            setattr(self, "entry" if word == "ENTRYPOINT" else "command", json.loads(rest))
        elif word == "SHELL":
            self.shell = json.loads(rest)
        elif word == "HEALTHCHECK":
            self.health = json.loads(rest.partition("CMD ")[2])
        elif word == "COPY":
            self._copy(rest)
        elif word == "RUN":
            passed = {name: value for name, value in os.environ.items() if KEPT.fullmatch(name)}
            done = subprocess.run(
                self.wrapped(*self.shell, rest, user="0"), env={**passed, **self.environment, **arguments},
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert done.returncode == 0, f"RUN {rest}\n{done.stdout[-1500:]}{done.stderr[-2500:]}"
        elif word not in ("FROM", "EXPOSE", "ARG"):
            raise AssertionError(f"{word} is not known here")

    def _copy(self, rest: str) -> None:
        *names, target = rest.split()
        place = self.root / self.folder.lstrip("/") / target
        for name in names:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / name, place)


@contextmanager
def build_image(
    stage: str, folder: Path, arguments: Mapping[str, str] | None = None
) -> Iterator[ChrootImage]:
    """A stage, built step by step in ``folder``; ``arguments`` are those of ARG."""
    for name in ("upper", "work", "root"):
        (folder / name).mkdir(parents=True)
    root = folder / "root"
    layers = f"lowerdir=/,upperdir={folder / 'upper'},workdir={folder / 'work'}"
    mounts = [["-t", "overlay", "overlay", "-o", layers, str(root)]]
    mounts += [["--bind", name, str(root / name.lstrip("/"))] for name in ("/proc", "/dev")]
    try:
        for mount in mounts:
            subprocess.run(["mount", *mount], check=True, capture_output=True)
        for name in ("/root", "/root/.pyenv"):  # where this machine's Python may be
            if (root / name.lstrip("/")).is_dir():
                (root / name.lstrip("/")).chmod(0o755)
        image = ChrootImage(root, {"PATH": os.environ["PATH"], "HOME": "/tmp"})
        for at, word, rest in instructions():
            if at in ("base", stage):
                image.take(word, rest, arguments or {})
        yield image
    finally:
        for mount in reversed(mounts):
            subprocess.run(["umount", "--lazy", mount[-1]], check=False, capture_output=True)
        shutil.rmtree(folder / "upper", ignore_errors=True)
