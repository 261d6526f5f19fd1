"""A training loop of one's own: pictures of a scene in, a scene of other Gaussians out.

    python examples/own_training.py scene.ply

The tracer is a function of torch, so that losses, parameters and optimisers are anybody's. Without an
argument it learns a ball of stripes.
"""

import sys

import numpy as np
import torch

import octasplat as osp


def striped_ball(count: int = 3000) -> osp.Scene:
    """A ball of radius 1, red and white."""
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    quats = np.stack(
        [1 + normals[:, 0], 0 * normals[:, 0], -normals[:, 2], normals[:, 1]], axis=1
    )  # x to normal
    colors = np.where(np.sin(8 * normals[:, 1:2]) > 0, [[0.9, 0.2, 0.1]], [[0.9, 0.9, 0.9]])
    sh = ((colors - 0.5) / 0.2821)[:, None]
    return osp.Scene.from_arrays(normals, quats, np.full((count, 2), 0.06), np.full(count, 0.95), sh)


def train(target: osp.Scene, steps: int = 150, count: int = 1500) -> tuple[osp.Scene, list[float]]:
    """Return a scene that looks like ``target``, and the PSNR of a view that was held out, every 50 steps."""
    held_out, *cameras = target.turntable(9, width_px=64, height_px=64)
    pictures = [torch.from_numpy(osp.render(target, camera).rgb.reshape(-1, 3)) for camera in cameras]
    right = torch.from_numpy(osp.render(target, held_out).rgb.reshape(-1, 3))
    random = np.random.default_rng(1)
    means = random.choice(target.means, count) + random.normal(scale=0.15, size=(count, 3))
    start = osp.Scene.from_arrays(
        means,
        random.normal(size=(count, 4)),
        np.full((count, 2), 0.08),
        np.full(count, 0.3),
        np.zeros((count, 1, 3)),
    )
    gaussians = osp.GaussianTensors.of(start)
    rates = (2e-3, 1e-2, 1e-2, 5e-2, 2e-2)
    optimizer = torch.optim.Adam(
        [{"params": [part], "lr": rate} for part, rate in zip(gaussians.tensors(), rates, strict=True)]
    )
    quality = []
    for step in range(steps + 1):
        if step % 50 == 0:
            with torch.no_grad():
                error = torch.mean((osp.trace(gaussians, held_out).rgb - right) ** 2)
            quality.append(-10 * float(torch.log10(error)))
        view = int(random.integers(len(cameras)))
        seen = osp.trace(gaussians, cameras[view])
        loss = torch.abs(seen.rgb - pictures[view]).mean() + 0.01 * seen.alpha.mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return gaussians.scene(), quality


if __name__ == "__main__":
    scene, psnr = train(osp.load(sys.argv[1]) if len(sys.argv) > 1 else striped_ball())
    print("PSNR of the held-out view:", ", ".join(f"{value:.1f} dB" for value in psnr))
    osp.save(scene, "learnt.ply")
