"""Shading model of a finished run, with the light, background and exposures that it learnt."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.gaussians.materials import has_materials, is_material_known
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_files import read_background_map, read_environment
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.residual_file import read_residual
from octasplat.engine.runs.run_folder import (
    BACKGROUND,
    CONFIG,
    is_full_run,
    run_environment,
    run_exposures,
    run_extent,
    run_viewpoints,
)
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.shading.residual_colors import ResidualColors
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.shading_factory import (
    ShadingOptions,
    add_residual,
    find_background,
    find_deferred,
    find_exposures,
    make_shading,
)


def shown_options(config: TrainConfig, gaussians: FlatGaussians) -> ShadingOptions:
    """Return what a run has learnt, without materials where its scene has none, or only some of it has.

    Edits may have left them out, or put a scene without materials to it, of which harmonics alone are known.
    """
    options = ShadingOptions.from_config(config)
    return options if is_material_known(gaussians).all() else replace(options, materials=None)


def learned_materials(output: Path, gaussians: FlatGaussians) -> DeferredShading | None:
    """Return the shading of a finished run's materials in the light that it has learnt.

    Args:
        output: folder of the run, or a file, which holds no light.
        gaussians: its scene.

    Returns:
        None where nothing was learnt, or some Gaussians have no materials.

    Raises:
        ConfigError: the run learnt light and its file is missing or damaged.
    """
    if not (is_full_run(output) and has_materials(gaussians)):
        return None
    options = shown_options(read_config(output / CONFIG).train, gaussians)
    if options.materials is None:
        return None
    extent = run_extent(output, run_viewpoints(output).extent)
    return find_deferred(finished_shading(output, options, extent))


def finished_shading(
    output: Path,
    options: ShadingOptions,
    extent_world: float,
    view_names: Sequence[str] = (),
    *,
    scene: FlatGaussians | None = None,
    trace: TraceSettings | None = None,
) -> ShadingModel:
    """Return the shading model of a finished run with its environment, background, residual and exposures.

    Args:
        output: folder of the run.
        options: what it learnt; of exposures, what its record says.
        extent_world: of the scene.
        view_names: the photographs of the run, by whose exposures its views are shown; without any the
            model has no exposures.
        scene: the run's own, whose residual colors are added to materials in the learnt light; None leaves
            them out.
        trace: where rays that show residual colors are cut off.

    Raises:
        ConfigError: the run learnt one of these and its file is missing or damaged.
    """
    known = run_exposures(output) if view_names else None
    shading = make_shading(replace(options, learns_exposure=known is not None), len(view_names), extent_world)
    if (deferred := find_deferred(shading)) is not None:
        # EXR if there is one, as it was learnt
        deferred.light.set_radiance(read_environment(run_environment(output)))
    if (background := find_background(shading)) is not None:
        background.set_map(read_background_map(output / BACKGROUND))
    residual_sh = None if deferred is None or scene is None else read_residual(output, scene)
    if deferred is not None and scene is not None and residual_sh is not None:
        tracer = make_tracer(trace, threads=threads_in_use())
        shading = add_residual(shading, ResidualColors(deferred, scene, residual_sh, tracer))
    if known is not None and (exposures := find_exposures(shading)) is not None:
        exposures.load_known(view_names, known)
    return shading
