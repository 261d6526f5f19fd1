from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.edit.mask_selection import mostly_inside, photograph_of_mask
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace import weight_sums
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import RECORDED_RAYS_PER_BATCH, TraceResult

PHOTOGRAPHS = ["0001.jpg", "left/0001.jpg", "right/0001.jpg", "right/0002.jpg", "right/0002.png", "far/9.jpg"]


@pytest.mark.parametrize(
    ("mask", "photograph"),
    [
        ("masks/left/0001.png", "left/0001.jpg"),
        ("masks/right/0001.png", "right/0001.jpg"),
        ("masks/right/0001.jpg.png", "right/0001.jpg"),
        ("masks/0001.png", "0001.jpg"),
        ("masks/0001.jpg.png", "0001.jpg"),
        ("masks/right/0002.jpg.png", "right/0002.jpg"),
        ("masks/right/0002.png.png", "right/0002.png"),
        ("anywhere/9.png", "far/9.jpg"),  # no other has this name
    ],
)
def test_mask_matches_photograph_in_own_folder(mask: str, photograph: str) -> None:
    assert PHOTOGRAPHS[photograph_of_mask(Path(mask), PHOTOGRAPHS)] == photograph
    back = PHOTOGRAPHS[::-1]
    assert back[photograph_of_mask(Path(mask), back)] == photograph


def test_ambiguous_mask_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"may be a mask of left/0001\.jpg and right/0001\.jpg"):
        photograph_of_mask(Path("0001.png"), PHOTOGRAPHS[1:])
    with pytest.raises(ConfigError, match=r"right/0002\.jpg and right/0002\.png"):
        photograph_of_mask(Path("masks/right/0002.png"), PHOTOGRAPHS)
    with pytest.raises(ConfigError, match="no photograph of this name"):
        photograph_of_mask(Path("masks/0003.png"), PHOTOGRAPHS)


class LargestBatchTracer(CpuTracer):
    """A tracer that keeps the largest number of rays that it recorded at once."""

    most_recorded = 0

    def trace(self, rays: RayBatch, *, record: bool = False) -> TraceResult:
        self.most_recorded = max(self.most_recorded, len(rays) if record else 0)
        return super().trace(rays, record=record)


def test_masks_of_large_views_record_some_rays_at_a_time(
    make_scene: Callable[..., FlatGaussians], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorded ray takes some 20 KB."""
    scene = make_scene(50, sh_degree=0, size=0.3)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 320), np.linspace(-0.5, 0.5, 240))
    ways = np.stack([x, y, np.ones_like(x)], axis=-1)
    image = ImageRays.from_directions(
        np.array([0.0, 0.0, -3.0]), ways / np.linalg.norm(ways, axis=2, keepdims=True)
    )
    mask = np.asarray(x < 0.1)
    assert min(mask.sum(), (~mask).sum()) < RECORDED_RAYS_PER_BATCH < mask.sum()
    tracer = LargestBatchTracer(threads=1)
    tracer.build(scene)
    chosen = mostly_inside(tracer, len(scene), [(image, mask)])
    assert 0 < tracer.most_recorded <= RECORDED_RAYS_PER_BATCH
    monkeypatch.setattr(weight_sums, "RECORDED_RAYS_PER_BATCH", mask.size)
    np.testing.assert_array_equal(mostly_inside(tracer, len(scene), [(image, mask)]), chosen)
    assert 0 < chosen.sum() < len(scene)
