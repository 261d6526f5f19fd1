"""What stands in ``config.json`` and ``metrics.json`` names every package that a result depends on."""

import ast
import importlib.metadata
import sys
from pathlib import Path

from octasplat.engine.core.versions import package_versions

ROOT = Path(__file__).resolve().parent.parent
HARMLESS = {"pydantic", "pydantic_core", "jaxtyping", "Jinja2", "pyoidn", "platformdirs", "pyproj"}
"""Checks of values, layout of the report, denoiser of stages, places of folders, meanings of EPSG numbers: no
figure is theirs."""


def imported_names(module: str) -> set[str]:
    """Full names of all modules that a module of the engine imports anywhere in its text."""
    path = ROOT / "src" / Path(*module.split("."))
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    names: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def is_module(name: str) -> bool:
    path = ROOT / "src" / Path(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def packages_behind(module: str) -> set[str]:
    """Top-level names outside of the project and of Python that ``module`` leads to."""
    waiting, seen, outside = [module], set[str](), set[str]()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        for imported in imported_names(name):
            if imported.startswith("octasplat.engine."):
                waiting += [imported] if is_module(imported) else []
            else:
                outside.add(imported.partition(".")[0])
    return outside - set(sys.stdlib_module_names) - {"octasplat"}


def test_versions_cover_reconstruction_packages() -> None:
    # Some are one extension module, without a record of its name; "_" and "-" mean the same.
    owners = importlib.metadata.packages_distributions()
    names = {owners.get(name, [name])[0] for name in packages_behind("octasplat.engine.pipeline")} - HARMLESS
    behind = {name.replace("_", "-") for name in names}
    counted = package_versions()
    assert behind >= {"torch", "numba", "pycolmap"}
    assert not behind - set(counted)
    assert counted["torch"] == importlib.metadata.version("torch")
