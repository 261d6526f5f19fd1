"""Photographs to scenes of flat Gaussians, by ray tracing on an ordinary CPU.

>>> import octasplat as osp
>>> scene = osp.load("scene.ply")
>>> scene
Scene(1,200 Gaussians, harmonics of degree 1)
>>> image = osp.render(scene, scene.camera(width_px=96, height_px=64))
>>> image.rgb.shape
(64, 96, 3)

What is named here is loaded when it is first used, so that the import is quick: neither torch nor numba, nor
anything of the service, comes with it. Nothing is printed; progress and warnings go to the logger
``octasplat``, and in a notebook to its output.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from octasplat.engine import __version__

if TYPE_CHECKING:
    from octasplat.client import Client, Job, JobFailedError, ServiceError
    from octasplat.engine.core.errors import CancelledError, ConfigError, OctasplatError
    from octasplat.engine.render.pinhole_camera import PinholeCamera as Camera
    from octasplat.engine.trace.protocol import TraceSettings
    from octasplat.images import Image
    from octasplat.rendering import render
    from octasplat.runs import Run
    from octasplat.scenes import Scene, load, save
    from octasplat.tracing import GaussianTensors, Rays, TracedRays, trace
    from octasplat.verbs import (
        clean,
        crop,
        deform,
        edit,
        estimate,
        evaluate,
        export,
        import_,
        info,
        material,
        merge,
        plan,
        reconstruct,
        relight,
        simplify,
        stage_init,
        surface,
        transform,
    )
    from octasplat.viewer import Viewer, view

_SOURCES = {
    "Camera": ("engine.render.pinhole_camera", "PinholeCamera"),
    "CancelledError": ("engine.core.errors", "CancelledError"),
    "Client": ("client", "Client"),
    "ConfigError": ("engine.core.errors", "ConfigError"),
    "GaussianTensors": ("tracing", "GaussianTensors"),
    "Image": ("images", "Image"),
    "Job": ("client", "Job"),
    "JobFailedError": ("client", "JobFailedError"),
    "OctasplatError": ("engine.core.errors", "OctasplatError"),
    "Rays": ("tracing", "Rays"),
    "Run": ("runs", "Run"),
    "Scene": ("scenes", "Scene"),
    "ServiceError": ("client", "ServiceError"),
    "TraceSettings": ("engine.trace.protocol", "TraceSettings"),
    "TracedRays": ("tracing", "TracedRays"),
    "Viewer": ("viewer", "Viewer"),
    "clean": ("verbs", "clean"),
    "crop": ("verbs", "crop"),
    "deform": ("verbs", "deform"),
    "edit": ("verbs", "edit"),
    "estimate": ("verbs", "estimate"),
    "evaluate": ("verbs", "evaluate"),
    "export": ("verbs", "export"),
    "import_": ("verbs", "import_"),
    "info": ("verbs", "info"),
    "load": ("scenes", "load"),
    "material": ("verbs", "material"),
    "merge": ("verbs", "merge"),
    "plan": ("verbs", "plan"),
    "reconstruct": ("verbs", "reconstruct"),
    "relight": ("verbs", "relight"),
    "render": ("rendering", "render"),
    "save": ("scenes", "save"),
    "simplify": ("verbs", "simplify"),
    "stage_init": ("verbs", "stage_init"),
    "surface": ("verbs", "surface"),
    "trace": ("tracing", "trace"),
    "transform": ("verbs", "transform"),
    "view": ("viewer", "view"),
}
"""Module below this one, and the name in it, of everything public."""

__all__ = [
    "Camera",
    "CancelledError",
    "Client",
    "ConfigError",
    "GaussianTensors",
    "Image",
    "Job",
    "JobFailedError",
    "OctasplatError",
    "Rays",
    "Run",
    "Scene",
    "ServiceError",
    "TraceSettings",
    "TracedRays",
    "Viewer",
    "__version__",
    "clean",
    "crop",
    "deform",
    "edit",
    "estimate",
    "evaluate",
    "export",
    "import_",
    "info",
    "load",
    "material",
    "merge",
    "plan",
    "reconstruct",
    "relight",
    "render",
    "save",
    "simplify",
    "stage_init",
    "surface",
    "trace",
    "transform",
    "view",
]


def __getattr__(name: str) -> object:
    """Import what is public when it is first used."""
    if name not in _SOURCES:
        raise AttributeError(f"module 'octasplat' has no attribute '{name}'")
    module, attribute = _SOURCES[name]
    try:
        value: object = getattr(import_module(f"octasplat.{module}"), attribute)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"octasplat.{name} needs '{error.name}', which is not installed; install octasplat, of which "
            "octasplat-client is only the part that talks to a service."
        ) from error
    # From here on Python finds the name without asking this function.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
