"""The slow twin of split-sum shading: plain torch in float64, gradients by autograd."""

import numpy as np
import torch

from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels
from octasplat.engine.shading.split_sum import split_sum_table


def bilinear(texels: torch.Tensor, offset: int, height: int, direction: torch.Tensor) -> torch.Tensor:
    """Value of an equirectangular level at unit directions (right, up, forward)."""
    width = 2 * height
    x, y, z = direction.unbind(1)
    across = (0.5 + torch.atan2(x, z) / (2 * torch.pi)) * width - 0.5
    down = torch.clamp(torch.acos(y.clamp(-1, 1)) / torch.pi * height - 0.5, 0, height - 1)
    left, top = across.detach().floor(), down.detach().floor().clamp(max=height - 2)
    u, v = (across - left)[:, None], (down - top)[:, None]
    columns = [(left.long() + k) % width for k in (0, 1)]
    corner = [[texels[offset + (top.long() + j) * width + columns[i]] for i in (0, 1)] for j in (0, 1)]
    upper = corner[0][0] * (1 - u) + corner[0][1] * u
    lower = corner[1][0] * (1 - u) + corner[1][1] * u
    return upper * (1 - v) + lower * v


def table_value(cosine: torch.Tensor, roughness: torch.Tensor) -> torch.Tensor:
    table = torch.from_numpy(split_sum_table())
    y, x = roughness * (table.shape[0] - 1), cosine * (table.shape[1] - 1)
    j, i = (
        y.detach().floor().clamp(max=table.shape[0] - 2).long(),
        x.detach().floor().clamp(max=table.shape[1] - 2).long(),
    )
    y, x = (y - j)[:, None], (x - i)[:, None]
    upper = table[j, i] * (1 - x) + table[j, i + 1] * x
    lower = table[j + 1, i] * (1 - x) + table[j + 1, i + 1] * x
    return upper * (1 - y) + lower * y


def reference_split_sum(
    material: torch.Tensor,
    normal: torch.Tensor,
    direction: torch.Tensor,
    visibility: torch.Tensor,
    indirect: torch.Tensor,
    ambient: torch.Tensor,
    bounced: torch.Tensor,
    texels: torch.Tensor,
    light: EnvironmentLevels,
    frame: np.ndarray,
) -> torch.Tensor:
    """Linear colors; ``texels`` stands for those of ``light``."""
    turn = torch.from_numpy(frame)
    albedo, metallic, roughness = material[:, :3], material[:, 3:4], material[:, 4]
    cosine = -(normal * direction).sum(1)
    reflected = (direction + 2 * cosine[:, None] * normal) @ turn.T
    levels = [
        bilinear(texels, int(offset), int(height), reflected)
        for offset, height in zip(light.offsets[:-1], light.heights[:-1], strict=True)
    ]
    around = torch.zeros_like(indirect)
    for k, (low, high) in enumerate(zip(light.roughnesses[:-1], light.roughnesses[1:], strict=True)):
        share = ((roughness.clamp(light.roughnesses[0], 1) - low) / (high - low))[:, None]
        inside = ((share >= 0) & (share < 1)).double()
        around = around + inside * (levels[k] * (1 - share) + levels[k + 1] * share)
    scale, bias = table_value(cosine.clamp(min=1e-3), roughness).unbind(1)
    f0 = 0.04 * (1 - metallic) + metallic * albedo
    lit = bilinear(texels, int(light.offsets[-1]), int(light.heights[-1]), normal @ turn.T)
    seen = visibility[:, None] * around + indirect
    matt = (1 - metallic) * albedo * (ambient[:, None] * lit + bounced)
    return (f0 * scale[:, None] + bias[:, None]) * seen + matt
