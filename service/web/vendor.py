"""Makes ``static/vendor`` anew from npm packages at pinned versions.

Run as ``python -m octasplat.service.web.vendor``.

Needs node and npm, which nobody else does: what it makes is part of the repository.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

WEB_FOLDER = Path(__file__).parent
VENDORING_FOLDER = WEB_FOLDER / "vendoring"
VENDOR_FOLDER = WEB_FOLDER / "static" / "vendor"
BUNDLES = ("three", "uplot", "sha256")
COPIES = {"htmx.js": "htmx.org/dist/htmx.min.js", "uplot.css": "uplot/dist/uPlot.min.css"}
LICENCES = ("three", "uplot", "htmx.org", "@noble/hashes")


def build_vendor_files(target: Path = VENDOR_FOLDER) -> None:
    """Install the packages in a temporary folder, bundle them, and replace ``target``.

    Raises:
        subprocess.CalledProcessError: npm or esbuild failed; they have said why.
    """
    npm = shutil.which("npm")
    if npm is None:
        raise SystemExit("npm is needed to make static/vendor anew; install Node.js.")
    with tempfile.TemporaryDirectory(prefix="octasplat-vendor-") as name:
        folder = Path(name)
        shutil.copytree(VENDORING_FOLDER, folder, dirs_exist_ok=True)
        command = [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", "--silent"]
        subprocess.run(command, cwd=folder, check=True)  # noqa: S603 - of our own making
        modules = folder / "node_modules"
        made = folder / "made"
        made.mkdir()
        for bundle in BUNDLES:
            _bundle_modules(modules, folder / f"{bundle}.js", made / f"{bundle}.js")
        for copy, source in COPIES.items():
            text = (modules / source).read_text(encoding="utf-8")
            # The source maps that these lines name are left out.
            lines = [line for line in text.splitlines() if not line.startswith("//# sourceMappingURL")]
            (made / copy).write_text("\n".join(lines) + "\n", encoding="utf-8")
        (made / "LICENSES.txt").write_text(_licence_texts(modules), encoding="utf-8")
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(made, target)


def _bundle_modules(modules: Path, entry: Path, output: Path) -> None:
    """Return one minified ES module with everything that ``entry`` imports."""
    esbuild = modules / "esbuild" / "bin" / "esbuild"
    options = ("--bundle", "--minify", "--format=esm", "--target=es2022", "--legal-comments=none")
    node = shutil.which("node") or "node"
    command = [
        node,
        str(esbuild),
        str(entry),
        *options,
        "--charset=utf8",
        "--log-level=warning",
        f"--outfile={output}",
    ]
    subprocess.run(command, check=True)  # noqa: S603 - of our own making


def _licence_texts(modules: Path) -> str:
    """Return the names, versions and licences of the bundled packages."""
    parts = []
    for package in LICENCES:
        facts = json.loads((modules / package / "package.json").read_text(encoding="utf-8"))
        text = (modules / package / "LICENSE").read_text(encoding="utf-8").strip()
        parts.append(f"{facts['name']} {facts['version']} ({facts['license']})\n\n{text}\n")
    return ("\n" + "-" * 80 + "\n\n").join(parts)


if __name__ == "__main__":
    build_vendor_files()
    sys.stdout.write(
        "".join(f"{path.name} {path.stat().st_size}\n" for path in sorted(VENDOR_FOLDER.iterdir()))
    )
