"""Digests of what a few small runs give, which tell whether the same settings still give the same results.

    python -m benchmarks.result_digests            # print what differs from the stored digests
    python -m benchmarks.result_digests --write    # store those of this machine in tests/result_digests.json

Bytes may differ between CPUs and between versions of the libraries, so each such combination has digests of
its own. Where they differ from the stored ones ``RESULTS_VERSION`` of ``engine/core/versions.py`` is to be
raised, with a line in the changelog, and the digests are stored again; until then they are not.
"""

import argparse
import hashlib
import json
import platform
import tempfile
from pathlib import Path
from typing import Any

import llvmlite.binding
from PIL import Image

import octasplat as osp
from octasplat.engine.core.versions import RESULTS_VERSION, package_versions
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset

STORED = Path(__file__).parents[1] / "tests" / "result_digests.json"
_PLY_HEADER_END = b"end_header\n"


def machine_key() -> str:
    """Return what bytes may depend on besides the code: the type of CPU, and the versions of the packages."""
    features = llvmlite.binding.get_host_cpu_features().flatten()
    packages = {name: version for name, version in package_versions().items() if name != "octasplat"}
    parts = (_short_digest(features), _short_digest(json.dumps(packages, sort_keys=True)))
    return "-".join((platform.machine(), llvmlite.binding.get_host_cpu_name(), *parts))


def make_digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of what a training, a render and an export give, run in an empty folder."""
    dataset = SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=400)
    write_synthetic_dataset(folder / "scene", dataset)
    osp.reconstruct(
        folder / "scene",
        folder / "run",
        preset="fast",
        iterations=120,
        rays_per_batch=512,
        max_gaussians=500,
        exports=[],
        train={"initial_points": 300, "densify_from_iter": 20, "densify": {"start": 30, "interval": 20}},
    )
    osp.render(folder / "run", folder / "views", views="held-out", format="png")
    osp.export(folder / "run", [folder / "octagons.ply"])
    images = sorted((folder / "views").rglob("*.png"))
    assert images
    return {
        "training": _digest(_ply_payload(folder / "run" / "scene.ply")),
        "render": _digest(b"".join(Image.open(path).tobytes() for path in images)),
        "export": _digest(_ply_payload(folder / "octagons.ply")),
    }


def read_stored(path: Path = STORED) -> dict[str, Any]:
    """Return the stored digests: a results version, and digests by machine."""
    stored: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return stored


def with_digests(stored: dict[str, Any], key: str, digests: dict[str, str], version: int) -> dict[str, Any]:
    """Return stored digests with those of a machine; those of another version go.

    Raises:
        ValueError: those of the machine differ, and the version is the same.
    """
    machines = stored["machines"] if stored["results_version"] == version else {}
    if machines.get(key, digests) != digests:
        raise ValueError(
            f"The results differ from those stored for RESULTS_VERSION {version}; raise it in "
            "engine/core/versions.py and say why in CHANGELOG.md, then store the digests."
        )
    return {"results_version": version, "machines": dict(sorted({**machines, key: digests}.items()))}


def main(arguments: list[str] | None = None) -> int:
    """Compare or store the digests of this machine."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="store them")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        digests = make_digests(Path(folder))
    key, stored = machine_key(), read_stored()
    for name, digest in digests.items():
        known = stored["machines"].get(key, {}).get(name)
        print(f"{name}: {'not stored' if known is None else 'as stored' if known == digest else 'differs'}")
    if options.write:
        try:
            changed = with_digests(stored, key, digests, RESULTS_VERSION)
        except ValueError as error:
            print(f"Error: {error}")
            return 1
        STORED.write_text(json.dumps(changed, indent=1) + "\n", encoding="utf-8")
    return 0


def _ply_payload(path: Path) -> bytes:
    """Return what follows the header of a PLY; the header may name the program's version."""
    _, _, payload = path.read_bytes().partition(_PLY_HEADER_END)
    assert payload
    return payload


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _short_digest(text: str) -> str:
    return _digest(text.encode("utf-8"))[:8]


if __name__ == "__main__":
    raise SystemExit(main())
