"""Options that all renders share: cameras and image formats."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.axes import Axis
from octasplat.engine.operations.base import Options, WritingRequest
from octasplat.engine.render.file_names import IMAGE_SUFFIXES, UNWRITTEN_SUFFIXES, has_number_pattern
from octasplat.engine.render.path_document import (
    MAX_FRAMES,
    PathDocument,
    parse_path_text,
    read_path_document,
)
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import ADVANCED, DatasetFolder, Output, ReadPath, Source, Spelling, Unit

Mode = Literal["turntable", "views", "path", "camera"]
Format = Literal["mp4", "png", "exr"]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
PhotographName = Annotated[str, Field(min_length=1, max_length=1000)]

DEFAULT_FPS = 30.0
_OF_TURNTABLES = ("frames", "seconds", "distance", "elevation_degrees", "look_at")
"""Options that say what a turntable is like; with them a run is not shown in its photographs' views."""
MAX_SIDE_PX = 16384
UP_OF_RUN_UNUSED = (
    "The axis that points up (up) goes with a file; the photographs of a run say so themselves, and it is "
    "passed over."
)


class PictureOptions(Options):
    """Options of which cameras view the scene, and which images are rendered."""

    mode: Annotated[Mode, Spelling(hidden=True)] = Field(
        "turntable",
        description="The cameras: one turn round the scene, the views of the photographs, a camera path, or "
        "a single camera.",
    )
    views: Literal["held-out", "train", "all"] = Field(
        "held-out",
        description="Render the views of the photographs: those held out, those trained on, or all. Only of "
        "a run.",
    )
    photographs: Annotated[tuple[PhotographName, ...] | None, Spelling(("--photograph",), metavar="NAME")] = (
        Field(
            None,
            min_length=1,
            max_length=1000,
            description="Render the views of the photographs with these names. Only of a run.",
        )
    )
    camera_path: Annotated[
        PathDocument | None,
        BeforeValidator(parse_path_text, json_schema_input_type=PathDocument | str | None),
        Spelling(hidden=True),
    ] = Field(
        None,
        description="The cameras of a path, as docs/cameras.md describes its file: an object, or the text "
        "of the file.",
    )
    camera: Annotated[Point | None, Spelling(metavar="X Y Z")] = Field(
        None,
        description="Render one image with a camera at this position, which looks at the middle of the scene "
        "or at another point that is given.",
    )
    look_at: Annotated[Point | None, ADVANCED, Spelling(metavar="X Y Z")] = Field(
        None,
        description="Turntable, single camera: the point that is looked at.  [default: the middle of the "
        "scene]",
    )
    distance: Annotated[float | None, Unit("scene units"), ADVANCED] = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="Turntable: distance of the camera from the point that is looked at, in scene units.  "
        "[default: as photographed, or what fits]",
    )
    elevation_degrees: Annotated[float | None, Unit("degrees"), ADVANCED, Spelling(("--elevation",))] = Field(
        None,
        ge=-89,
        le=89,
        description="Turntable: elevation of the camera above the point that is looked at, in degrees.  "
        "[default: as photographed, or 20]",
    )
    frames: Annotated[int, Unit("images")] = Field(
        120, ge=1, le=MAX_FRAMES, description="Turntable: number of images of one turn."
    )
    seconds: Annotated[float | None, Unit("s"), ADVANCED] = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="Turntable: duration of one turn in seconds, instead of a number of images.",
    )
    fps: Annotated[float | None, Unit("images/s"), ADVANCED] = Field(
        None,
        gt=0,
        le=1000,
        description="Images per second of a video.  [default: that of the camera path, or 30]",
    )
    width_px: Annotated[int, Unit("px"), Spelling(("--width",), metavar="PX")] = Field(
        640,
        ge=16,
        le=MAX_SIDE_PX,
        description="Turntable, single camera: width of the images in pixels.",
    )
    height_px: Annotated[int, Unit("px"), Spelling(("--height",), metavar="PX")] = Field(
        480,
        ge=16,
        le=MAX_SIDE_PX,
        description="Turntable, single camera: height of the images in pixels.",
    )
    fov_y_degrees: Annotated[float | None, Unit("degrees"), ADVANCED, Spelling(("--fov",))] = Field(
        None,
        ge=1,
        le=170,
        description="Turntable, single camera: field of view from the top of the image to its bottom, in "
        "degrees.  [default: that of the photographs, or 50]",
    )
    up: Annotated[Axis | None, ADVANCED] = Field(
        None,
        description="The axis of a file that points up; the photographs of a run say so themselves.  "
        "[default: -y]",
    )
    max_side: Annotated[int | None, Unit("px"), Spelling(metavar="PX")] = Field(
        None,
        ge=16,
        description="Views of the photographs: longer side of the images in pixels.  [default: that of the "
        "run]",
    )
    format: Annotated[Format, Spelling(hidden=True)] = Field(
        "mp4", description="A video (mp4), or images: PNG, or EXR with linear values."
    )

    @property
    def is_single(self) -> bool:
        """Return whether there is one camera, whatever the scene."""
        return self.mode == "camera" or (self.mode == "turntable" and self.frame_count == 1)

    @property
    def frame_count(self) -> int:
        """Return the number of images of a turntable, camera path or single camera; views not counted."""
        if self.mode == "camera":
            return 1
        if self.mode == "path" and self.camera_path is not None:
            return self.camera_path.frame_count
        return self.frames if self.seconds is None else max(1, round(self.seconds * self.frame_rate))

    @property
    def frame_rate(self) -> float:
        """Return the images per second."""
        # a path file says how fast it is shown
        if self.fps is None and self.mode == "path" and self.camera_path is not None:
            return self.camera_path.fps
        return self.fps or DEFAULT_FPS

    def unused(self) -> tuple[str, ...]:
        """Return a sentence for each given option that has no effect on such images."""
        is_placed = self.mode in ("turntable", "camera")
        rules = {
            "max_side": ("The longer side", "views of photographs", self.mode == "views"),
            "frames": ("The number of images of a turn", "a turntable", self.mode == "turntable"),
            "seconds": ("The duration of a turn", "a turntable", self.mode == "turntable"),
            "width_px": ("The width", "a turntable or a single camera", is_placed),
            "height_px": ("The height", "a turntable or a single camera", is_placed),
            "fov_y_degrees": ("The field of view", "a turntable or a single camera", is_placed),
            "fps": (
                "The number of images per second",
                "a video",
                self.format == "mp4" or self.seconds is not None,
            ),
        }  # fmt: skip
        return tuple(
            f"{noun} ({name}) goes with {whose} and is passed over."
            for name, (noun, whose, is_used) in rules.items()
            if not is_used and getattr(self, name) != type(self).model_fields[name].default
        )

    @model_validator(mode="after")
    def _cameras_fit(self) -> "PictureOptions":
        if self.mode == "views" and self.format == "mp4":
            raise ValueError(
                "views of photographs are images: name a folder, or for a video a turntable or a path of "
                "cameras"
            )
        if self.mode != "views" and self.photographs is not None:
            raise ValueError("photographs are views; choose the mode views")
        for mode, name in (("path", "camera_path"), ("camera", "camera")):
            if (self.mode == mode) != (getattr(self, name) is not None):
                raise ValueError(f"the mode {mode} and `{name}` go together; give both or none")
        if self.mode in ("views", "path"):
            for name in ("look_at", "distance", "elevation_degrees"):
                if getattr(self, name) is not None:
                    raise ValueError(f"`{name}` goes with a turntable or a single camera")
        if self.mode == "camera" and not (self.distance is None and self.elevation_degrees is None):
            raise ValueError(
                "`camera` says where the camera stands; leave out `distance` and `elevation_degrees`"
            )
        if self.mode == "camera" and self.format == "mp4":
            raise ValueError("there is one image; choose the format png or exr (name a folder or an image)")
        # a default cannot be told from the same number given
        if self.seconds is not None and self.frames != type(self).model_fields["frames"].default:
            raise ValueError("choose one of `frames` and `seconds`")
        if self.seconds is not None and self.frame_count > MAX_FRAMES:
            raise ValueError(f"`seconds` and `fps` make more than {MAX_FRAMES:,} images")
        if getattr(self, "background", None) == "transparent" and self.format == "mp4":  # subclasses have it
            raise ValueError("a video has no alpha; choose images (name a folder), or another background")
        return self


class PictureRequest(PictureOptions, WritingRequest):
    """A render with the scene to read and the place to write images.

    Where they are not given, the format is that of the output's name, and the mode that of the cameras that
    are given; a video and options of a turntable alone mean one. Else it is the views of a run, or a
    turntable of a file.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DATASET

    source: Source = Field(description="The scene to render: the folder of a run, or a file of any format.")
    output: Output = Field(
        description="A folder, a pattern such as frames/%04d.png (or .exr), or a video such as turn.mp4."
    )
    dataset: DatasetFolder = Field(
        None,
        description="Take the cameras of the photographs in this folder.  [default: those that the run "
        "keeps]",
    )
    path_file: Annotated[Path | None, Spelling(("--path",), metavar="FILE"), ReadPath()] = Field(
        None, description="Render the cameras of a JSON file; docs/cameras.md tells its format."
    )
    resume: bool = Field(False, description="Go on with a render that was stopped, if there is one.")
    or_anew: Annotated[bool, Spelling(hidden=True)] = Field(
        False, description="Begin anew where the images that are there are of another render."
    )
    frames_folder: Annotated[Path | None, Spelling(hidden=True)] = Field(
        None, description="Where a video keeps its frames until it is whole.  [default: beside it]"
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_values(cls, values: Any) -> Any:
        # refused by the fields themselves
        if not isinstance(values, dict) or "output" not in values or "source" not in values:
            return values
        given = renamed_settings.replace_former_names((cls,), values)
        # None stands for what was not given, so that the defaults below apply
        given = {name: value for name, value in given.items() if value is not None}
        if "path_file" in given and "camera_path" not in given:
            given["camera_path"] = read_path_document(Path(given["path_file"]))
        if "mode" not in given:
            given["mode"] = cls._mode_of(given)
        if "format" not in given:
            suffix = Path(given["output"]).suffix.lower().removeprefix(".")
            given["format"] = suffix if suffix in ("mp4", "exr") else "png"
        return given

    @classmethod
    def _mode_of(cls, given: dict[str, Any]) -> str:
        modes = {"views": "views", "photographs": "views", "camera_path": "path", "camera": "camera"}
        found = {mode for name, mode in modes.items() if name in given}
        if len(found) > 1:
            raise ValueError("choose one of views, a turntable, a camera path and a single camera")
        if found:
            return found.pop()
        is_video = Path(given["output"]).suffix.lower() == ".mp4" or given.get("format") == "mp4"
        if is_video or any(name in given for name in _OF_TURNTABLES):
            return "turntable"
        # imported late: numba and scipy come with it
        from octasplat.engine.runs.run_folder import is_full_run

        return "views" if is_full_run(Path(given["source"])) else "turntable"

    @model_validator(mode="after")
    def _output_fits(self) -> "PictureRequest":
        suffix = self.output.suffix.lower()
        if suffix in UNWRITTEN_SUFFIXES:
            raise ValueError(
                f"{self.output}: images are written as .png or .exr and films as .mp4; name one of these, or "
                "a folder"
            )
        if (suffix == ".mp4") != (self.format == "mp4"):
            if suffix == ".mp4":
                raise ValueError("EXR and PNG are images; name a folder or an image instead of a video")
            raise ValueError(f"{self.output} is no video; give it a name such as turn.mp4")
        if suffix == ".png" and self.format == "exr":
            raise ValueError("the format EXR and the name of a .png contradict each other")
        if suffix == ".exr" and self.format == "png":
            raise ValueError("the format PNG and the name of an .exr contradict each other")
        several = self.mode == "turntable" and not self.is_single  # one frame needs no pattern
        if several and self._needs_pattern and not has_number_pattern(self.output):
            raise ValueError(f"{self.output} names one image; write a pattern such as frame_%04d{suffix}")
        if self.mode == "views" and not self._has_views:
            raise ValueError(
                "views of photographs need the folder of a run; a file has turntables, camera paths and "
                "single cameras"
            )
        return self

    @property
    def _is_image(self) -> bool:
        return self.output.suffix.lower() in IMAGE_SUFFIXES

    @property
    def _needs_pattern(self) -> bool:
        return self._is_image

    @property
    def _has_views(self) -> bool:
        from octasplat.engine.runs.run_folder import is_full_run

        return is_full_run(self.source)


def check_layers(output: Path) -> None:
    """Check that the output's format can hold the layers of a stage.

    Raises:
        ConfigError: the name is that of a PNG or of a video.
    """
    if output.suffix.lower() in (".png", ".mp4"):
        raise ConfigError(f"{output}: holds no layers; name a folder, or .exr files.")
