# ruff: noqa: T201
"""What a user writes, checked by mypy --strict and never run."""

from pathlib import Path
from typing import assert_type

import numpy as np
import torch

import octasplat as osp
from octasplat.engine.core.events import TrainingProgress


def stop(step: TrainingProgress) -> bool:
    return step.psnr < 30


run = osp.reconstruct("photos/", Path("out"), preset="fast", max_side=800, on_step=stop)
run = osp.reconstruct("photos/", "out", resume=True)
assert_type(run, osp.Run)
scene = osp.load(run)
osp.save(scene, "b.spz")
brighter = np.clip(scene.opacities * 1.1, 0, 0.99)
scene.opacities = brighter
scene.means[:, 2] += 1.0
scene.means += np.array([0, 0, 0.5])
scene.scales *= 2
image = osp.render(scene, scene.camera(), background="white")
assert_type(image, osp.Image)
pose = np.eye(4)
pose[:3, 3] = (0, 0, -4)
assert_type(osp.render(scene, osp.Camera.from_pose(pose, 96, 64, fy_px=80)), osp.Image)
assert_type(osp.render(run.scene, run.cameras["0001.jpg"]), osp.Image)
nearest = np.unique(image.gaussian[image.alpha > 0.5])
scene.select(nearest)
pictures = osp.render(run, "views/", views="all", width_px=320)
print(pictures.images + 1, osp.evaluate(run).psnr, osp.surface(run, "s.glb", max_triangles=10_000).files)
osp.relight(run, "relit.mp4", environments=["studio.hdr"])
osp.edit(run, "edited.ply", meshes=["edited.obj"])
osp.edit(run, "edited.ply", meshes=Path("edited.obj"))
osp.merge("a.ply", "both.ply", Path("b.ply"))
osp.merge(["a.ply", Path("b.ply")], "both.ply")
osp.transform("a.ply", "b.ply", matrix=np.eye(4))
osp.transform("a.ply", "b.ply", matrix=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.5]], about=np.zeros(3))
osp.crop("a.ply", "b.ply", box=(0, 0, 0, 1, 1, 1))
parameters = osp.GaussianTensors.of(scene)
seen = osp.trace(parameters, osp.Rays.of(osp.Camera.looking_at((0, 0, -4), (0, 0, 0), 64, 48)))
assert_type(seen.rgb, torch.Tensor)
viewer = osp.view(scene)
with osp.Client("http://127.0.0.1:8642", "token") as client:
    job = client.submit("photos/", preset="fast", train={"iterations": 2000})
    files = job.wait().download("out/")
    assert_type(files, tuple[Path, ...])
    render = client.derive(job, "render", frames=60)
    try:
        render.wait()
    except (osp.JobFailedError, osp.ServiceError) as failed:
        print(failed)
try:
    osp.load("missing.ply")
except osp.OctasplatError as error:
    print(error)
