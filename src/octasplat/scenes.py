"""Scenes in memory: their parameters as arrays, read from and written to files of any format."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import MAX_LOGIT
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import RowIndex
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata
from octasplat.notebook import log_event, table_html
from octasplat.paths import PathLike

if TYPE_CHECKING:
    from octasplat.engine.dataset import Viewpoints
    from octasplat.engine.render.pinhole_camera import PinholeCamera
    from octasplat.engine.shading.deferred import DeferredShading
    from octasplat.engine.trace.protocol import TraceSettings


class Scene:
    """Flat Gaussians, and what a file says of them as a whole.

    >>> import numpy as np
    >>> import octasplat as osp
    >>> scene = osp.load("scene.ply")
    >>> len(scene), scene.means.shape, scene.quats.shape, scene.scales.shape, scene.opacities.shape
    (1200, (1200, 3), (1200, 4), (1200, 2), (1200,))
    >>> scene.sh.shape, scene.sh_degree
    ((1200, 4, 3), 1)

    ``means``, ``quats``, ``log_scales``, ``opacity_logits`` and ``sh`` are views: what is written to them
    changes the scene. What is assigned must have the same shape, but that ``sh`` may be of another degree.

    >>> scene.means += np.array([0, 0, 1])
    """

    def __init__(
        self,
        gaussians: FlatGaussians,
        facts: SceneMetadata = UNKNOWN_METADATA,
        materials: "DeferredShading | None" = None,
        trained_with: "TraceSettings | None" = None,
        viewpoints: "Viewpoints | None" = None,
        residual_sh: Float32[np.ndarray, "n k 3"] | None = None,
    ) -> None:
        """Take over the engine's Gaussians; :meth:`from_arrays` makes a scene of plain arrays.

        Args:
            gaussians: the scene.
            facts: what a file says of it as a whole.
            materials: shading of its materials in the light that a run has learnt.
            trained_with: how a run has traced it; None where that is not known.
            viewpoints: where its photographs were taken from; None where that is not known.
            residual_sh: harmonics of what its materials in that light do not explain of the photographs;
                pictures in that light add it. None leaves it out, as is right once materials were changed.
        """
        self.gaussians = gaussians
        self.facts = facts
        self.materials = materials
        self.trained_with = trained_with
        self.viewpoints = viewpoints
        self._residual_sh = residual_sh

    @classmethod
    def from_arrays(
        cls,
        means: Float[np.ndarray, "n 3"],
        quats: Float[np.ndarray, "n 4"],
        scales: Float[np.ndarray, "n 2"],
        opacities: Float[np.ndarray, " n"],
        sh: Float[np.ndarray, "n k 3"],
        channels: Mapping[str, Float[np.ndarray, "n f"]] | None = None,
    ) -> "Scene":
        """Return a scene of these parameters, which are copied.

        Args:
            means: centres, world units.
            quats: rotations (w, x, y, z) of any length; the columns of the matrix are the normal and the two
                axes in the plane.
            scales: standard deviations along these axes, world units.
            opacities: from 0 to 1.
            sh: spherical harmonics of the display color, 1, 4, 9 or 16 coefficients a Gaussian.
            channels: further numbers of each Gaussian, by name.

        Raises:
            ConfigError: an array has another shape, or a value is out of range.

        >>> import numpy as np
        >>> import octasplat as osp
        >>> osp.Scene.from_arrays(
        ...     means=np.zeros((1, 3)),
        ...     quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=np.ones((1, 2)),
        ...     opacities=np.array([0.9]),
        ...     sh=np.ones((1, 1, 3)),
        ... )
        Scene(1 Gaussian, harmonics of degree 0)
        """
        count, coefficients = len(means), _as_numpy(sh)
        _check_sh(coefficients, count)
        further: dict[str, Float32[np.ndarray, "n f"]] = {}
        for name, values in (channels or {}).items():
            further[name] = np.array(_as_numpy(values), np.float32)
            if further[name].ndim != 2 or len(further[name]) != count:
                raise ConfigError(
                    f"channels: {name!r} has the shape {further[name].shape}; it must be ({count}, f)."
                )
        return cls(
            FlatGaussians(
                _rows("means", means, (count, 3)),
                _rows("quats", quats, (count, 4)),
                _rows("scales", _log_scales(scales), (count, 2)),
                _rows("opacities", _opacity_logits(opacities), (count,)),
                np.array(coefficients, np.float32),
                Channels(further),
            )
        )

    @property
    def means(self) -> Float32[np.ndarray, "n 3"]:
        """Return the centres, in world units."""
        return self.gaussians.means_world

    @means.setter
    def means(self, values: Float[np.ndarray, "n 3"]) -> None:
        _put("means", self.gaussians.means_world, values)

    @property
    def quats(self) -> Float32[np.ndarray, "n 4"]:
        """Rotations (w, x, y, z), of any length; the first column of the matrix is the normal."""
        return self.gaussians.quats_wxyz

    @quats.setter
    def quats(self, values: Float[np.ndarray, "n 4"]) -> None:
        _put("quats", self.gaussians.quats_wxyz, values)

    @property
    def log_scales(self) -> Float32[np.ndarray, "n 2"]:
        """Natural logarithms of :attr:`scales`."""
        return self.gaussians.log_scales

    @log_scales.setter
    def log_scales(self, values: Float[np.ndarray, "n 2"]) -> None:
        _put("log_scales", self.gaussians.log_scales, values)

    @property
    def scales(self) -> Float32[np.ndarray, "n 2"]:
        """Standard deviations along the two axes in the plane, world units; a copy, but it can be set."""
        return self.gaussians.scales

    @scales.setter
    def scales(self, values: Float[np.ndarray, "n 2"]) -> None:
        _put("scales", self.gaussians.log_scales, _log_scales(values))

    @property
    def opacity_logits(self) -> Float32[np.ndarray, " n"]:
        """Return the logits of :attr:`opacities`, before the sigmoid."""
        return self.gaussians.opacity_logits

    @opacity_logits.setter
    def opacity_logits(self, values: Float[np.ndarray, " n"]) -> None:
        _put("opacity_logits", self.gaussians.opacity_logits, values)

    @property
    def opacities(self) -> Float32[np.ndarray, " n"]:
        """Opacities in (0, 1); a copy, but they can be set."""
        return self.gaussians.opacities

    @opacities.setter
    def opacities(self, values: Float[np.ndarray, " n"]) -> None:
        _put("opacities", self.gaussians.opacity_logits, _opacity_logits(values))

    @property
    def sh(self) -> Float32[np.ndarray, "n k 3"]:
        """Spherical harmonics of the display color, coefficient-major."""
        return self.gaussians.sh

    @sh.setter
    def sh(self, values: Float[np.ndarray, "n k 3"]) -> None:
        coefficients = _as_numpy(values)
        _check_sh(coefficients, len(self))
        if coefficients.shape == self.gaussians.sh.shape:
            # In place, as somebody may hold a view of the array.
            self.gaussians.sh[...] = coefficients
        else:  # of another degree
            self.gaussians.sh = np.array(coefficients, np.float32)

    @property
    def residual_sh(self) -> Float32[np.ndarray, "n k 3"] | None:
        """Harmonics of what materials in the learnt light do not explain; None leaves them out."""
        return self._residual_sh

    @residual_sh.setter
    def residual_sh(self, values: Float[np.ndarray, "n k 3"] | None) -> None:
        if values is None:
            self._residual_sh = None
            return
        coefficients = _as_numpy(values)
        _check_sh(coefficients, len(self), "residual_sh")
        self._residual_sh = np.array(coefficients, np.float32, order="C")

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return self.gaussians.sh_degree

    @property
    def channels(self) -> Mapping[str, np.ndarray]:
        """Return the further channels of each Gaussian, such as albedo, by name."""
        return self.gaussians.channels

    @property
    def normals(self) -> Float32[np.ndarray, "n 3"]:
        """Unit normals, a copy."""
        return self.gaussians.rotations[:, :, 0].copy()

    def select(self, index: RowIndex | Sequence[int] | int) -> "Scene":
        """Return the Gaussians of numbers, a mask or a slice, copied; of a single number, one Gaussian.

        >>> import octasplat as osp
        >>> scene = osp.load("scene.ply")
        >>> len(scene.select(scene.opacities > 0.5)) < len(scene)
        True
        """
        rows = index if isinstance(index, slice) else np.atleast_1d(_as_numpy(index))
        if len(self) and not isinstance(rows, slice) and rows.size == 0:
            rows = np.zeros(0, np.int64)  # of an empty list, which has no type
        residual_sh = None if self.residual_sh is None else self.residual_sh[rows]
        return self._with(self.gaussians.select(rows), residual_sh)

    def copy(self) -> "Scene":
        """Return an independent copy."""
        residual_sh = None if self.residual_sh is None else self.residual_sh.copy()
        return self._with(self.gaussians.copy(), residual_sh)

    def _with(self, gaussians: FlatGaussians, residual_sh: Float32[np.ndarray, "n k 3"] | None) -> "Scene":
        return Scene(gaussians, self.facts, self.materials, self.trained_with, self.viewpoints, residual_sh)

    @property
    def trace_settings(self) -> "TraceSettings":
        """Return how rays are traced: as the run of the scene has, or as its file says."""
        from octasplat.engine.trace.protocol import TraceSettings

        return self.trained_with or TraceSettings(flip_normal_cos=self.facts.turned_beyond)

    def camera(
        self, width_px: int = 640, height_px: int = 480, *, fov_y_degrees: float | None = None
    ) -> "PinholeCamera":
        """Return the first camera of :meth:`turntable`.

        >>> import octasplat as osp
        >>> camera = osp.load("scene.ply").camera(width_px=96, height_px=64)
        >>> camera.width_px, camera.height_px
        (96, 64)
        """
        return self.turntable(1, width_px, height_px, fov_y_degrees=fov_y_degrees)[0]

    def turntable(
        self,
        frames: int,
        width_px: int = 640,
        height_px: int = 480,
        *,
        fov_y_degrees: float | None = None,
    ) -> tuple["PinholeCamera", ...]:
        """Return cameras that go round the scene once, as those of :func:`octasplat.render` do.

        The scene of a run is seen from where its photographs were taken, about, which also say what is up. Of
        others the whole scene is seen, with -y up as in most scenes that COLMAP made. Nothing is seen nearer
        than the scene's file says.

        Args:
            frames: how many cameras.
            width_px: of their images.
            height_px: of their images.
            fov_y_degrees: angle of view from top to bottom; by default that of the photographs, or 50.

        Raises:
            ConfigError: there are no frames, or an image has no pixels or no field of view.

        >>> import octasplat as osp
        >>> len(osp.load("scene.ply").turntable(12))
        12
        """
        from octasplat.engine.render.orbit import Orbit, PinholeLens, choose_fov_y_degrees, orbit_cameras
        from octasplat.engine.render.pinhole_camera import check_lens

        angle = choose_fov_y_degrees(fov_y_degrees, self.viewpoints)
        check_lens(width_px, height_px, angle)
        lens, orbit = PinholeLens(int(width_px), int(height_px), angle), Orbit(np.array([0.0, -1.0, 0.0]))
        try:
            cameras = orbit_cameras(self.gaussians, self.viewpoints, lens, orbit, frames)
        except ConfigError:
            if self.viewpoints is None:
                raise
            # Photographs that share no up direction go round nothing.
            cameras = orbit_cameras(self.gaussians, None, lens, orbit, frames)
        return tuple(replace(camera, near_world=self.facts.near_world) for camera in cameras)

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        plural = "" if len(self) == 1 else "s"
        more = f", channels {', '.join(self.channels)}" if self.channels else ""
        return f"Scene({len(self):,} Gaussian{plural}, harmonics of degree {self.sh_degree}{more})"

    def _repr_html_(self) -> str:
        corners = (self.means.min(axis=0), self.means.max(axis=0)) if len(self) else ()
        return table_html(
            "Scene",
            {
                "Gaussians": f"{len(self):,}",
                "harmonics": f"degree {self.sh_degree}",
                "channels": ", ".join(self.channels) or "none",
                "centres": " to ".join(" ".join(f"{value:.4g}" for value in corner) for corner in corners)
                or "none",
            },
        )


def _as_numpy(values: Any) -> np.ndarray:
    """Return an array of what may also be a list, or a tensor with gradients or of another device."""
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values)


def _rows(name: str, values: Float[np.ndarray, "..."], shape: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Return a copy as float32; refuses another shape, and what no file of a scene may hold."""
    rows = np.array(_as_numpy(values), np.float32)
    if rows.shape != shape:
        raise ConfigError(f"{name}: has the shape {rows.shape}; it must be {shape}.")
    if not np.isfinite(rows).all():
        raise ConfigError(f"{name}: must be finite.")
    if name == "quats" and not rows.any(axis=1).all():
        raise ConfigError("quats: must be rotations, and 0 0 0 0 is none.")
    return rows


def _put(name: str, rows: Float32[np.ndarray, "..."], values: Float[np.ndarray, "..."]) -> None:
    """Overwrite rows by values of the same shape."""
    rows[...] = _rows(name, values, rows.shape)


def _check_sh(values: Float[np.ndarray, "..."], count: int, name: str = "sh") -> None:
    """Refuse what are no coefficients of so many Gaussians."""
    shape = values.shape
    if len(shape) != 3 or shape[0] != count or shape[1] not in (1, 4, 9, 16) or shape[2] != 3:
        raise ConfigError(f"{name}: has the shape {shape}; it must be ({count}, k, 3) with k 1, 4, 9 or 16.")
    if not np.isfinite(values).all():
        raise ConfigError(f"{name}: must be finite.")


def _log_scales(scales: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return the logarithms of standard deviations; refuses those that have none."""
    values = np.asarray(_as_numpy(scales), np.float64)
    if not (np.isfinite(values) & (values > 0)).all():
        raise ConfigError("scales: must be finite and above 0.")
    return np.log(values)


def _opacity_logits(opacities: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return what the sigmoid turns into opacities, finite for 0 and 1, too; refuses what is none."""
    values = np.asarray(_as_numpy(opacities), np.float64)
    if not ((values >= 0) & (values <= 1)).all():
        raise ConfigError("opacities: must be from 0 to 1.")
    # The logarithm of 0 is -inf, which the clip makes finite.
    with np.errstate(divide="ignore"):
        return np.clip(np.log(values) - np.log1p(-values), -MAX_LOGIT, MAX_LOGIT)


def load(source: PathLike, *, drop_invalid: bool = False) -> Scene:
    """Return the scene of a file of any format, or of a run.

    With a run comes where its photographs were taken from, how it has traced rays, and the light that it has
    learnt, if it has materials; :func:`octasplat.render` shows them in it. What reading loses, as the
    thickness of Gaussians that were not flat, is logged.

    Args:
        source: the file, a run or its folder, or the folder of an unpacked SOG.
        drop_invalid: leave out Gaussians with values that are not finite, instead of refusing the file.

    Raises:
        SceneFileError: the file cannot be read.
        ConfigError: a run's settings or light cannot be read.
        TypeError: what is given is no path.

    >>> import octasplat as osp
    >>> osp.load("scene.ply")
    Scene(1,200 Gaussians, harmonics of degree 1)
    """
    if not isinstance(source, str | os.PathLike):
        raise TypeError(f"load takes the path of a file or run, not {source!r}")
    return read_scene(Path(source), log_event, drop_invalid=drop_invalid)


def read_scene(path: Path, progress: EventListener, *, drop_invalid: bool = False) -> Scene:
    """Return the scene of a file or run as :func:`load`, where ``progress`` is told what reading loses.

    Raises:
        SceneFileError: the file cannot be read.
        ConfigError: a run's settings or light cannot be read.
    """
    from octasplat.engine.files import read_metadata
    from octasplat.engine.operations.scene_io import open_reported_scene
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.finished_shading import learned_materials
    from octasplat.engine.runs.residual_file import read_residual
    from octasplat.engine.runs.run_folder import CONFIG, VIEWS, is_full_run, run_viewpoints

    gaussians, report = open_reported_scene(path, progress, drop_invalid=drop_invalid)
    materials = learned_materials(path, gaussians)
    settings = read_config(path / CONFIG).train.trace if is_full_run(path) else None
    # Runs of old keep no cameras, and their photographs may be anywhere.
    viewpoints = run_viewpoints(path) if settings is not None and (path / VIEWS).exists() else None
    residual_sh = None if materials is None else read_residual(path, gaussians, report.kept)
    return Scene(gaussians, read_metadata(path), materials, settings, viewpoints, residual_sh)


def save(scene: Scene, path: PathLike) -> Path:
    """Write a scene in the format that the suffix of ``path`` says, and return the path.

    What the format leaves out is logged.

    Raises:
        SceneFileError: no format has that suffix, or the file cannot be written.
        TypeError: what is given is no scene.

    >>> import octasplat as osp
    >>> osp.save(osp.load("scene.ply"), "smaller.spz").name
    'smaller.spz'
    >>> len(osp.load("smaller.spz"))
    1200
    """
    from octasplat.engine.operations.scene_io import write_scene

    if not isinstance(scene, Scene):
        raise TypeError(f"save takes a scene, not {scene!r}; load() gives that of a file or run")
    target = Path(path)
    write_scene(scene.gaussians, scene.facts, target, log_event)
    return target
