"""The front end starts without the engine's heavy parts."""

import json
import subprocess
import sys
from pathlib import Path

from engine.scene.generated import GeneratedSceneConfig, write_generated_scene

HEAVY = ("torch", "numba", "llvmlite", "pycolmap", "embreex", "scipy", "OpenImageIO", "matplotlib")
CODE = f"""
import json, sys
import service.app, service.__main__
service.app.create_app()
print(json.dumps([name for name in {HEAVY!r} if name in sys.modules]))
"""


def test_no_heavy_module_is_imported() -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        timeout=60,
    )
    assert json.loads(done.stdout) == []


CHECK = """
import sys
for name in ("torch", "numba", "llvmlite", "embreex", "scipy", "OpenImageIO", "matplotlib"):
    sys.modules[name] = None
from pathlib import Path
from service.intake.model_child import ModelRequest, check
root = Path(sys.argv[1])
files = {path.name: path.relative_to(root).as_posix() for path in root.glob("sparse/0/*")}
sizes = {path.name: (48, 36) for path in (root / "images").iterdir()}
answer = check(ModelRequest(
    root=root, files=files, sizes_px=sizes, min_views=3, memory_bytes=1 << 40, cpu_seconds=600
))
assert not answer.faults and answer.views == 4, answer
"""


def test_models_are_checked_without_what_the_front_end_has_not(tmp_path: Path) -> None:
    config = GeneratedSceneConfig(views=4, width_px=48, height_px=36, samples_per_side=1, points=100)
    write_generated_scene(tmp_path / "scene", config)
    done = subprocess.run(
        [sys.executable, "-c", CHECK, str(tmp_path / "scene")],
        capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2], timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
