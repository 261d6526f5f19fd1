"""The front end starts without the engine's heavy parts."""

import json
import subprocess
import sys
from pathlib import Path

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset

HEAVY = ("torch", "numba", "llvmlite", "pycolmap", "embreex", "scipy", "OpenImageIO", "matplotlib")
CODE = f"""
import json, sys
import octasplat.service.app, octasplat.service.serving
octasplat.service.app.create_app()
print(json.dumps([name for name in {HEAVY!r} if name in sys.modules]))
"""


def test_front_end_loads_no_heavy_modules() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        timeout=240,
    )
    assert json.loads(done.stdout) == []


BLOCK = """
import importlib.metadata, re, sys, tomllib
def names(lines):
    return {re.split(r"[ \\[<>=~;]", line)[0].lower() for line in lines if line and line[0] != "#"}
with open("pyproject.toml", "rb") as file:
    wanted = names(tomllib.load(file)["project"]["dependencies"])
with open("docker/front-end.txt") as file:
    absent = wanted - names(file.read().splitlines())
for module, owners in importlib.metadata.packages_distributions().items():
    if {owner.lower() for owner in owners} <= absent:
        sys.modules[module] = None
assert sys.modules["torch"] is None and sys.modules["numba"] is None
"""
"""Of what the project needs, just docker/front-end.txt is there."""
CHECK = (
    BLOCK
    + """
from pathlib import Path
from octasplat.service.intake.model_child import ModelRequest, check
root = Path(sys.argv[1])
files = {path.name: path.relative_to(root).as_posix() for path in root.glob("sparse/0/*")}
sizes = {path.name: (48, 36) for path in (root / "images").iterdir()}
answer = check(ModelRequest(
    root=root, files=files, sizes_px=sizes, min_views=3, memory_bytes=1 << 40, cpu_seconds=600
))
assert not answer.faults and answer.views == 4, answer
"""
)
CHECK_GLASS = (
    BLOCK
    + """
from pathlib import Path
from octasplat.engine.pathtracing.stage.model import StageMesh
from octasplat.service.intake.mesh_child import MeshRequest, check
root = Path(sys.argv[1])
(root / "leaf.obj").write_text("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
leaf = StageMesh(file="leaf.obj", material={"kind": "glass"})
answer = check(MeshRequest(root=root, meshes={0: leaf}, memory_bytes=1 << 40, cpu_seconds=600))
assert answer.faults[0].startswith("meshes[0]: leaf.obj is not closed (3 edges"), answer
"""
)
ACCEPT = (
    BLOCK
    + """
from octasplat.engine.files import exporters
from octasplat.service.web.forms import options_form
from octasplat.workers.worker.job_kinds import get_job_kind, job_kinds
assert exporters()
for kind in job_kinds():
    options_form(kind)
    kind.options.model_json_schema()
files = ["a.glb", "b.ply", "c.obj", "d.spz", "e.sog", "f.splat", "g.usdz", "h.splats.glb"]
for name, asked in (("reconstruct", {"exports": files}), ("export", {"files": files})):
    get_job_kind(name).resolve(asked)
"""
)


def run_where_little_is_installed(code: str, *arguments: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2], timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_front_end_checks_models_without_engine_packages(tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=4, width_px=48, height_px=36, samples_per_side=1, points=100)
    write_synthetic_dataset(tmp_path / "scene", config)
    run_where_little_is_installed(CHECK, str(tmp_path / "scene"))


def test_front_end_checks_meshes_without_engine_packages(tmp_path: Path) -> None:
    run_where_little_is_installed(CHECK_GLASS, str(tmp_path))


def test_front_end_accepts_jobs_without_engine_packages() -> None:
    run_where_little_is_installed(ACCEPT)
