"""The files that a command enters on its way from its options to its results, its returns and its climbs.

    python -m benchmarks.file_walk -- render RUN --stage STAGE.toml -o OUT --max-side 32
    python -m benchmarks.file_walk --root ELSEWHERE -- render RUN --stage STAGE.toml -o OUT --max-side 32

The command runs twice in this process, first to import and compile, then with a profiler that notes each
call of a Python function from one file of the tree into another; calls by way of libraries count as made by
the last function of the tree. ``OUT`` is a new place each time. Compiled kernels are not followed.

A *step* is a pair of files of which the first has called the second; each pair counts once, so that loops do
not. A *return* is a step into a file that was entered before from elsewhere. A *climb* is a step from a
lower layer into a higher one, as ``LAYERS`` lists them; modules that everybody may use have no layer.
"""

import argparse
import importlib
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

LAYERS = (
    ("workers/cli",),
    ("workers/client", "workers/serve", "workers/work"),
    ("workers/rendering",),
    ("workers/telling",),
    ("engine/operations",),
    ("engine/pipeline",),
    ("engine/evaluate", "engine/pathtracing", "engine/edit"),
    ("engine/runs",),
    ("engine/poses",),
    ("engine/files",),
    ("engine/train", "engine/surface"),
    ("engine/render",),
    ("engine/dataset", "engine/shading"),
    ("engine/trace",),
    ("engine/gaussians",),
)
"""Folders and modules from the top down, as the contracts of ``pyproject.toml`` have them."""


class Walk:
    """A profiler that notes the steps between the files of a tree.

    Args:
        root: of the tree.
        start: ``file.py:function``; only what that function calls is noted. Everything, if it is empty.
    """

    def __init__(self, root: Path, start: str = "") -> None:
        self._root = root.resolve()
        self._start = start
        self._first: FrameType | None = None
        self._names: dict[str, str | None] = {}
        self.steps: dict[tuple[str, str], None] = {}
        self.calls: list[tuple[str, str]] = []

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Note a call into another file."""
        if self._start and not self._has_begun(frame, event):
            return
        if event != "call" or (callee := self._file(frame)) is None:
            return
        before = frame.f_back
        while before is not None and (caller := self._file(before)) is None:
            before = before.f_back
        if before is not None and caller is not None and caller != callee:
            self.steps[caller, callee] = None
            if not self.calls or self.calls[-1] != (caller, callee):
                self.calls.append((caller, callee))

    def _has_begun(self, frame: FrameType, event: str) -> bool:
        if self._first is None:
            if event == "call" and f"{self._file(frame)}:{frame.f_code.co_name}" == self._start:
                self._first = frame
            return False
        if frame is self._first and event == "return":
            self._start, self._first = "nothing", None
        return self._first is not None

    def _file(self, frame: FrameType) -> str | None:
        """The file of a function, relative to the tree; None for libraries and for this script."""
        name = frame.f_code.co_filename
        if name not in self._names:
            path = Path(name).resolve()
            inside = path.is_relative_to(self._root) and path.suffix == ".py"
            parts = path.relative_to(self._root).parts if inside else ()
            known = parts[:1] in (("engine",), ("workers",), ("service",))
            self._names[name] = "/".join(parts) if known else None
        return self._names[name]

    def returns(self) -> list[tuple[str, str]]:
        """Steps into files that were entered before from elsewhere."""
        entered: set[str] = set()
        found = []
        for caller, callee in self.steps:
            if callee in entered:
                found.append((caller, callee))
            entered |= {caller, callee}
        return found

    def climbs(self) -> list[tuple[str, str]]:
        """Steps from a lower layer into a higher one."""
        levels = [(layer_of(caller), layer_of(callee)) for caller, callee in self.steps]
        return [
            step
            for step, (lower, higher) in zip(self.steps, levels, strict=True)
            if lower is not None and higher is not None and higher < lower
        ]

    def visits(self, folder: str) -> list[str]:
        """Folders that the files of one folder call, in order; modules that everybody may use left out."""
        found: list[str] = []
        for caller, callee in self.calls:
            inside = [file.startswith(f"{folder}/") for file in (caller, callee)]
            if inside == [True, False] and layer_of(callee) is not None:
                place = "/".join(callee.removesuffix(".py").split("/")[:2])
                if found[-1:] != [place]:
                    found.append(place)
        return found


def layer_of(file: str) -> int | None:
    """The layer of a file, counted from the top; None for modules that everybody may use."""
    for level, names in enumerate(LAYERS):
        if any(file == f"{name}.py" or file.startswith(f"{name}/") for name in names):
            return level
    return None


def command_line(root: Path) -> Any:
    """The command line of a tree, of the layout of today or of the one before it."""
    for place, name in ((root / "src", "octasplat.workers.cli.main"), (root, "workers.cli.main")):
        if (place / name.partition(".")[0]).is_dir():
            sys.path.insert(0, str(place))
            return importlib.import_module(name).cli
    raise SystemExit(f"{root}: holds no octasplat.")


def main() -> None:
    """Run a command and tell its walk."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument(
        "--start", default="", metavar="FILE:FUNCTION", help="note only what this function calls"
    )
    parser.add_argument(
        "--of", default="", metavar="FOLDER", help="tell in order which folders this folder calls, too"
    )
    parser.add_argument("--list", action="store_true", help="list the files, the returns and the climbs")
    parser.add_argument("words", nargs="+", help="the command, without octasplat")
    given = parser.parse_args()
    cli = command_line(given.root.resolve())
    walk = Walk(given.root, given.start)
    for number in range(2):
        with tempfile.TemporaryDirectory() as folder:
            words = [word.replace("OUT", f"{folder}/out", 1) for word in given.words]
            if number == 1:
                sys.setprofile(walk)
            try:
                cli(words, standalone_mode=False)
            finally:
                sys.setprofile(None)
    files = {file for step in walk.steps for file in step}
    if given.list:
        print("\n".join(sorted(files)))
        for name, steps in (("return", walk.returns()), ("climb", walk.climbs())):
            for caller, callee in steps:
                print(f"{name}: {caller} -> {callee}")
    if given.of:
        visits = walk.visits(given.of)
        print(" -> ".join(visits))
        print(f"{len(set(visits))} folders, {len(visits)} visits, {len(visits) - len(set(visits))} returns")
    returns, climbs = len(walk.returns()), len(walk.climbs())
    print(f"{len(files)} files, {len(walk.steps)} steps, {returns} returns, {climbs} climbs")


if __name__ == "__main__":
    main()
