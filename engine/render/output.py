"""Output of a render: image files or a video, and the resumption of an interrupted one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, ImagesSaved
from octasplat.engine.core.progress import counted_phase
from octasplat.engine.render.file_names import IMAGE_SUFFIXES, has_number_pattern
from octasplat.engine.render.resume import RECORD_FILE, FinishedImages
from octasplat.engine.render.series import film_files, render_series, render_video
from octasplat.engine.render.shots import RenderFn, Shot


@dataclass(frozen=True)
class ResumeOptions:
    """Treatment of images left by an interrupted render.

    Attributes:
        resume: go on with them; else they are refused.
        or_anew: where they are of another render, forget them rather than refuse.
        frames_folder: folder of a film's frames; None puts them beside the film.
    """

    resume: bool = False
    or_anew: bool = False
    frames_folder: Path | None = None


@dataclass(frozen=True)
class RenderOutput:
    """Images or a video to write.

    Attributes:
        path: a folder, an image, a pattern such as ``frame_%04d.png``, or a film (``.mp4``).
        fps: images per second of a film.
        exr: whether images in a folder are EXR files; else they are PNG files.
        resumption: how the render goes on after a stop.
    """

    path: Path
    fps: float
    exr: bool
    resumption: ResumeOptions = ResumeOptions()

    @property
    def is_video(self) -> bool:
        """Return whether the output is a video."""
        return self.path.suffix.lower() == ".mp4"

    @property
    def is_image_name(self) -> bool:
        """Return whether the path names images rather than a folder or a video."""
        return self.path.suffix.lower() in IMAGE_SUFFIXES

    @property
    def folder(self) -> Path:
        """Return the folder that the files are written to."""
        return self.path.parent if self.is_video or self.is_image_name else self.path

    def check_count(self, images: int) -> None:
        """Check that one image name is not given for several images.

        Raises:
            ConfigError: they would all be one file.
        """
        if images > 1 and self.is_image_name and not has_number_pattern(self.path):
            pattern = f"{self.path.stem}_%04d{self.path.suffix}"
            raise ConfigError(f"{self.path} names one image for {images}; write a pattern such as {pattern}.")

    def path_for(self, number: int, shot: Shot) -> Path:
        """Return the file of a shot: by number in a pattern, by name in a folder."""
        if not self.is_image_name:
            return self.path / f"{shot.name}{'.exr' if self.exr else '.png'}"
        return self.path.with_name(self.path.name % number) if has_number_pattern(self.path) else self.path

    def numbered(self, shots: Sequence[Shot], *, counts: bool = False) -> tuple[list[str], ...]:
        """Return the names of the shots where their order matters, as digests take them; else nothing.

        Args:
            shots: the views of photographs, or cameras.
            counts: whether what a shot shows depends on its number; else its order matters where files have
                numbers only.
        """
        return ([shot.name for shot in shots],) if counts or self.is_image_name else ()

    def files_of(self, shots: Sequence[Shot]) -> tuple[Path, ...]:
        """Return all files that are written for shots: images, or a video and its frames."""
        if self.is_video:
            return (self.path, *film_files(self._frames_folder, len(shots)))
        return tuple(self.path_for(number, shot) for number, shot in enumerate(shots))

    @property
    def _frames_folder(self) -> Path:
        return self.resumption.frames_folder or self.path.with_name(f"{self.path.name}.frames")

    def finished_images(self, identity: str) -> FinishedImages:
        """Return the finished images of an earlier render with this identity.

        Raises:
            ConfigError: there are images of another render, or of one that is not to be gone on with.
        """
        how, record = self.resumption, self._record_path
        return FinishedImages(  # several patterns may share a folder
            record.parent, identity, resume=how.resume, or_anew=how.or_anew, record=record.name
        )

    @property
    def has_begun(self) -> bool:
        """Return whether there is an unfinished series."""
        return self._record_path.exists()

    @property
    def _record_path(self) -> Path:
        if self.is_image_name:
            return self.path.with_name(f"{self.path.name}.{RECORD_FILE}")
        return (self._frames_folder if self.is_video else self.path) / RECORD_FILE

    def write(
        self, shots: tuple[Shot, ...], render_fn: RenderFn, finished: FinishedImages, progress: EventListener
    ) -> tuple[Path, ...]:
        """Render the shots that are not finished yet, write all, and return the files.

        Raises:
            OutputError: a file cannot be written.
        """

        def on_kept(count: int) -> None:
            progress(ImagesSaved(count))

        with counted_phase("render", progress) as count:
            if self.is_video:
                render_video(
                    shots=shots,
                    film=self.path,
                    fps=self.fps,
                    render_fn=render_fn,
                    finished=finished,
                    progress=count,
                    on_finished=on_kept,
                )
                return (self.path,)
            return render_series(
                shots=shots,
                file_of=self.path_for,
                render_fn=render_fn,
                finished=finished,
                progress=count,
                on_finished=on_kept,
            )
