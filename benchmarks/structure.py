"""The folders and the arrows between them, drawn from the imports; and how long modules and functions are.

    python -m benchmarks.structure                      # this tree
    python -m benchmarks.structure --root ELSEWHERE     # another checkout
    python -m benchmarks.structure --write              # the marked parts of docs/architecture.md

An arrow says "imports". Folders in a circle, and arrows from engine to workers or from workers to service,
are told and make the exit status 1.
"""

import argparse
import ast
import statistics
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import grimp
import networkx as nx

from benchmarks.marked_parts import with_part

PACKAGES = ("engine", "workers", "service")
EVERYBODY = frozenset({"core"})
"""What any other may use; it would hide the rest of the drawing."""
PAGE = Path("docs") / "architecture.md"


def room_of(module: str) -> str | None:
    """The folder of a module; None for what all may use.

    ``octasplat.engine.trace.cpu.packets`` -> ``engine.trace``.
    """
    parts = module.split(".")[1:]
    if len(parts) < 2 or parts[0] not in PACKAGES or parts[1] in EVERYBODY:
        return None
    return ".".join(parts[:2])


def arrows(graph: grimp.ImportGraph) -> Counter[tuple[str, str]]:
    """Number of imports from each folder to each other one."""
    found: Counter[tuple[str, str]] = Counter()
    for module in graph.modules:
        here = room_of(module)
        for imported in graph.find_modules_directly_imported_by(module):
            there = room_of(imported)
            if here and there and here != there:
                found[here, there] += 1
    return found


def circles(edges: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Groups of folders, or of modules, that reach each other."""
    groups = nx.strongly_connected_components(nx.DiGraph(list(edges)))
    return sorted(sorted(group) for group in groups if len(group) > 1)


def upwards(edges: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Arrows against service -> workers -> engine."""
    level = {name: place for place, name in enumerate(PACKAGES)}
    return [(a, b) for a, b in edges if level[a.split(".")[0]] < level[b.split(".")[0]]]


def drawing(graph: grimp.ImportGraph) -> str:
    """Mermaid text: a frame for each package, an arrow for each pair of folders; single modules are left
    out.
    """
    edges = {
        (here, there)
        for here, there in arrows(graph)
        if graph.find_children(f"octasplat.{here}") and graph.find_children(f"octasplat.{there}")
    }
    lines = ["```mermaid", "flowchart LR"]
    rooms = sorted({room for edge in edges for room in edge})
    for package in reversed(PACKAGES):
        lines.append(f"  subgraph {package}")
        lines += [f"    {room}[{room.split('.')[1]}]" for room in rooms if room.split(".")[0] == package]
        lines.append("  end")
    # What reaches a folder by way of another one as well is left out: the drawing is about the order.
    whole = nx.DiGraph(sorted(edges))
    shown = whole if circles(edges) else nx.transitive_reduction(whole)
    lines += [f"  {here} --> {there}" for here, there in sorted(shown.edges)]
    return "\n".join([*lines, "```"])


def folders(root: Path) -> str:
    """Table of the folders with the first line of what their packages say of themselves."""
    lines = ["| Folder | What |", "|---|---|"]
    for package in PACKAGES:
        for path in sorted((root / package).glob("*/__init__.py")):
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            if text:
                lines.append(f"| `{path.parent.relative_to(root).as_posix()}/` | {text.splitlines()[0]} |")
    return "\n".join(lines)


def written_page(root: Path, graph: grimp.ImportGraph) -> str:
    """Text of docs/architecture.md, its marked parts made anew."""
    text = (root / PAGE).read_text(encoding="utf-8")
    for name, part in (("folders", folders(root)), ("drawing", drawing(graph))):
        text = with_part(text, name, "benchmarks.structure --write", part, page=PAGE.as_posix())
    return text


def sources(root: Path) -> Iterator[Path]:
    """The modules of the three packages."""
    for package in PACKAGES:
        yield from sorted((root / package).rglob("*.py"))


def sizes(root: Path) -> dict[str, list[tuple[int, str]]]:
    """Non-blank lines of modules, lines of functions, and arguments of functions, each with its place."""
    found: dict[str, list[tuple[int, str]]] = {"module lines": [], "function lines": [], "arguments": []}
    for path in sources(root):
        text, name = path.read_text(encoding="utf-8"), path.relative_to(root).as_posix()
        count = sum(1 for line in text.splitlines() if line.strip())
        if count > 1:
            found["module lines"].append((count, name))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                place = f"{name}:{node.name}"
                found["function lines"].append(((node.end_lineno or 0) - node.lineno + 1, place))
                given = node.args
                count = len(given.posonlyargs) + len(given.args) + len(given.kwonlyargs)
                found["arguments"].append((count, place))
    return found


def between_modules(graph: grimp.ImportGraph) -> list[tuple[str, str]]:
    """Every import of one module by another."""
    return [
        (here, there) for here in graph.modules for there in graph.find_modules_directly_imported_by(here)
    ]


def report(root: Path, graph: grimp.ImportGraph) -> bool:
    """Print all; returns whether there is neither a circle nor an arrow upwards."""
    print("| | median | 90 % | most | where |\n|---|---|---|---|---|")
    for what, values in sizes(root).items():
        numbers = sorted(value for value, _ in values)
        most = max(values)
        print(
            f"| {what} | {statistics.median(numbers):.0f} | {numbers[len(numbers) * 9 // 10]} "
            f"| {most[0]} | {most[1]} |"
        )
    edges = arrows(graph)
    against, rounds, small_rounds = upwards(edges), circles(edges), circles(between_modules(graph))
    print(
        f"\n{len({room for edge in edges for room in edge})} folders and single modules, {len(edges)} arrows,"
        f" {len(against)} upwards, {len(rounds)} circles of folders, {len(small_rounds)} of modules"
    )
    for here, there in against:
        print(f"  upwards: {here} -> {there}")
    for group in rounds:
        print(f"  circle: {', '.join(group)}")
        for (here, there), count in sorted(edges.items()):
            if here in group and there in group:
                print(f"    {here} -> {there} ({count})")
    for group in small_rounds:
        print(f"  circle of modules: {', '.join(group)}")
    return not against and not rounds and not small_rounds


def main() -> int:
    """Read the tree and tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parent.parent)
    parser.add_argument("--write", action="store_true", help=f"bring {PAGE} up to date")
    arguments = parser.parse_args()
    sys.path.insert(0, str(arguments.root.resolve() / "src"))
    graph = grimp.build_graph("octasplat", cache_dir=None)
    if arguments.write:
        page = written_page(arguments.root, graph)
        (arguments.root / PAGE).write_text(page, encoding="utf-8")
        return 0
    return 0 if report(arguments.root, graph) else 1


if __name__ == "__main__":
    sys.exit(main())
