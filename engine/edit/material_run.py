"""Material changes of a finished run's scene."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.edit.edit_options import MaterialChange
from octasplat.engine.edit.material_change import refit_sh, with_materials
from octasplat.engine.gaussians.materials import require_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, SCENE, is_run, run_environment
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_light import EnvironmentLight
from octasplat.engine.shading.recipes import material_shading


def change_materials(
    source: Path, gaussians: FlatGaussians, chosen: Bool[np.ndarray, " n"], change: MaterialChange
) -> FlatGaussians:
    """Return the scene of a run or file with the materials of the selected Gaussians changed.

    Where it is that of a run which learnt its environment, harmonics follow.

    Args:
        source: folder of the run, or file.
        gaussians: its scene.
        chosen: whose materials.
        change: what becomes of them.

    Raises:
        ConfigError: the scene has no materials, or nothing is chosen.
    """
    require_materials(gaussians, source / SCENE if is_run(source) else source)
    if not chosen.any():
        raise ConfigError(
            f"{source}: none of its {len(chosen):,} Gaussians is chosen, so nothing is changed."
        )
    changed = with_materials(gaussians, chosen, change)
    if not has_known_light(source):
        return changed
    settings = read_config(source / CONFIG).train.materials
    light = EnvironmentLight(settings.environment_height)
    light.set_radiance(read_environment(run_environment(source)))
    frame = environment_frame(np.array(settings.up_world, np.float64))
    return refit_sh(gaussians, changed, chosen, light.levels, frame)


def has_known_light(source: Path) -> bool:
    """Return whether the light is known in which a scene's harmonics show its materials."""
    if not is_run(source) or not run_environment(source).exists():
        return False
    return material_shading(read_config(source / CONFIG).train.materials.recipe).harmonics_are_shaded
