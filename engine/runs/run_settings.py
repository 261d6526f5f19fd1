"""Settings of a reconstruction other than those of its training; imports nothing heavy."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from octasplat.engine.runs.export_names import ExportNames
from octasplat.engine.runs.result_files import DEFAULT_EXPORTS
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import ADVANCED, BASIC, BoxCorners, Spelling, Unit
from octasplat.engine.settings.preset_names import PRESET_WORDS, PresetName


class RunSettings(BaseModel):
    """Settings of a reconstruction other than those of its training."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.RUN

    preset: Annotated[PresetName, BASIC] = Field(
        "standard",
        description="Where the settings of the training come from. "
        + "; ".join(f"{name}: {words.text.replace(';', ',')}" for name, words in PRESET_WORDS.items())
        + ".",
    )
    max_side: Annotated[int | None, Unit("px"), BASIC] = Field(
        None,
        ge=16,
        description="Longest side to which photographs are shrunk; by default they keep their size. Set it "
        "for a quick try, or where memory is short.",
    )
    test_every: Annotated[int, Unit("views"), BASIC] = Field(
        8,
        ge=0,
        description="Every N-th view by name is held out to be measured; 0 holds out none, so that "
        "all are trained on.",
    )
    held_out: Annotated[tuple[str, ...] | None, Spelling(metavar="NAME"), ADVANCED] = Field(
        None, description="Names of the views to hold out instead of every N-th."
    )
    split: Annotated[Literal["given", "every"], ADVANCED] = Field(
        "given",
        description="Which views are held out where the scene says so itself (transforms_test.json): given "
        "follows it, every takes every N-th view all the same.",
    )
    burst_length: Annotated[int, Unit("views"), ADVANCED] = Field(
        1,
        ge=1,
        description="So many views that follow each other by name, as frames of a video or shots of a burst, "
        "count as one where views are held out, so that none is measured by its neighbour. Photographs that "
        "are there twice always do.",
    )
    poses: Annotated[Literal["given", "auto", "missing"], BASIC] = Field(
        "missing",
        description="Where the poses of the cameras come from: given takes the COLMAP model of the dataset "
        "(photographs far from where matches put them are moved, see repair_poses); auto finds the poses, "
        "by COLMAP's features, matching and mapping; missing does so only where the dataset holds no model.",
    )
    model: Annotated[str | None, ADVANCED] = Field(
        None,
        min_length=1,
        description="Which of several models of the dataset gives the poses: its folder or its number, e.g. "
        "sparse/1, or transforms.json; by default the COLMAP model of most photographs. Of models that a "
        "search for poses finds: poses/1, or with the run that has found it, OUT/poses/1.",
    )
    masks: Annotated[Literal["ignore", "alpha"], ADVANCED] = Field(
        "ignore",
        description="What masks mean: ignore leaves masked pixels out of the loss, alpha takes the mask as "
        "the alpha, for objects that are cut out.",
    )
    depth_unit: Annotated[float | None, Unit("scene units"), ADVANCED] = Field(
        None,
        gt=0,
        description="World units for one unit of the values of depth maps (depths/); by default the sparse "
        "points decide, or metres where there are too few (0.001 for integers).",
    )
    evaluation_background: Annotated[Literal["black", "white"] | None, ADVANCED] = Field(
        None,
        description="What lies behind renders and photographs with alpha when they are compared; by default "
        "that of the training: white where background is white, else black.",
    )
    georeference: Annotated[Literal["auto", "gps", "off"], BASIC] = Field(
        "auto",
        description="What says where the scene lies, how large it is, and what is up: auto takes control "
        "points, else the GPS positions in the photographs where they agree with the scene; gps refuses the "
        "photographs where these do not; off looks for nothing, so that no file says where the photographs "
        "were taken.",
    )
    control_points: Annotated[str | None, Spelling(metavar="FILE"), ADVANCED] = Field(
        None,
        min_length=1,
        description="A file of ground control points in the folder of the photographs: gcp_list.txt as "
        "OpenDroneMap has it, or a CSV with name,x,y,z,photograph,px,py; by default gcp_list.txt or "
        "control_points.csv where there is one.",
    )
    known_length: Annotated[str | None, Spelling(metavar="'A B METRES'"), ADVANCED] = Field(
        None,
        min_length=5,
        description="Two points and the metres between them, which decide the scale; a point is a control "
        "point, a photograph, the number of a sparse point, or x,y,z.",
    )
    region: Annotated[
        BoxCorners | None, Unit("scene units"), Spelling(metavar="X0 Y0 Z0 X1 Y1 Z1"), ADVANCED
    ] = Field(
        None,
        description="Two corners of a box to train in detail, smallest coordinates first, in the "
        "coordinates of the COLMAP model; what lies around stays coarse. By default all of the scene is "
        "trained alike.",
    )
    minutes: Annotated[float | None, Unit("minutes"), BASIC] = Field(
        None,
        ge=0.1,
        le=100_000,
        description="Time in which the training is to end, which decides its iterations and Gaussians by the "
        "pace of the machine that begins it; by default the other settings do.",
    )
    exports: Annotated[ExportNames, Spelling(metavar="NAMES"), BASIC] = Field(
        DEFAULT_EXPORTS,
        max_length=100,
        description="Files to write besides scene.ply; their names say the format.",
    )

    @field_validator("region")
    @classmethod
    def _has_a_volume(cls, box: BoxCorners | None) -> BoxCorners | None:
        if box is not None and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("a region needs its smallest x, y, z first and then its largest ones")
        return box

    @model_validator(mode="before")
    @classmethod
    def _by_new_names(cls, given: Any) -> Any:
        return renamed_settings.replace_former_names((cls,), given) if isinstance(given, Mapping) else given
