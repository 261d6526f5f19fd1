"""The kind ``surface``: a mesh of the scene of a reconstruction."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.files import check_surface_path
from octasplat.engine.operations.base import Options
from octasplat.engine.operations.surface import OPERATION, SurfaceOptions
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand
from octasplat.workers.worker.task import Task

_PRESET_OPTIONS = ("room", "materials", "box")
"""Options that decide what others are where nothing is said of these."""


class SurfaceJobOptions(SurfaceOptions):
    """Options of ``surface``: how the surface is meshed and colored, and in which format."""

    format: Literal["glb", "ply", "obj", "usdz"] = Field(
        "glb", description="Format of the mesh, which is surface.glb, .ply, .obj or .usdz among the results."
    )

    @model_validator(mode="after")
    def _check_format(self) -> "SurfaceJobOptions":
        try:
            check_surface_path(
                Path(f"surface.{self.format}"),
                textured=self.texture_size is not None,
                lit=self.materials,
                is_written_here=False,
            )
        except ConfigError as error:
            raise ValueError(str(error).removesuffix(".")) from None
        return self


class SurfaceKind(OperationKind):
    """Kind of jobs that extract a mesh; colors are fitted to the photographs where these exist."""

    def __init__(self) -> None:
        super().__init__(
            OPERATION,
            title="One colored triangle mesh of the scene of a reconstruction",
            options=SurfaceJobOptions,
            stages=("depth", "fusing", "meshing"),
            source_files=(
                *("scene.ply", "config.json", "held_out.json", "views.json", "training.json"),
                *("environment.hdr", "georeference.json"),
            ),
            reports_stages=True,
        )

    def needs_photographs(self, options: SurfaceJobOptions) -> bool:
        """Return whether colors are fitted to photographs."""
        return options.fit and not options.materials

    def stages(self, options: SurfaceJobOptions) -> tuple[str, ...]:
        """Return the stages; colors that are fitted to photographs need not be seen in the scene first."""
        requested = {
            "settling": options.refine_vertices,
            "decimating": bool(options.max_triangles),
            "unwrapping": options.texture_size is not None,
            "coloring": options.materials or not options.fit,
            "fitting": options.fit and not options.materials,
        }
        return (*super().stages(options), *(name for name, is_asked in requested.items() if is_asked))

    def resource_demands(
        self, options: SurfaceJobOptions, sizes: Sequence[ImageSizes]
    ) -> tuple[ResourceDemand, ...]:
        """Return the sides of the maps, the pixels of all depth maps, one a photograph, and the files."""
        side_px = options.depth_side
        pixels = sum(
            size.count * side_px * max(1, side_px * min(size.width_px, size.height_px) // _longer_px(size))
            for size in sizes
        )
        return (
            ResourceDemand("depth_side", "side_px", side_px),
            ResourceDemand("texture_size", "side_px", options.texture_size or 0),
            ResourceDemand("depth_side", "render_pixels", pixels),
            ResourceDemand("max_triangles", "exports", max(1, len(options.levels))),
        )

    def revise(self, options: Mapping[str, Any], changes: Mapping[str, Any]) -> Options:
        """Return the options of a job with changes; what its presets decided follows those of now."""
        presets = {name: options[name] for name in _PRESET_OPTIONS if name in options}
        decided = self.resolve(presets).model_dump(mode="json")
        # What differs from the presets' choice was asked for, and stays.
        changed = {name: value for name, value in options.items() if decided.get(name) != value}
        return self.resolve({**presets, **changed, **changes})

    def request_paths(self, task: Task, options: SurfaceJobOptions) -> dict[str, Path]:
        """Return where a job reads and writes; photographs are those of a whole run only."""
        places = {"source": task.source, "output": task.results / f"surface.{options.format}"}
        if task.scene is not None and task.source == task.run:
            places["photographs"] = task.scene
        return places


def _longer_px(size: ImageSizes) -> int:
    return max(size.width_px, size.height_px)
