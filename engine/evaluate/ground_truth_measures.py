"""A scene measured against its truth: geometry and materials by view, and pictures under other light."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.events import EventListener, PhaseProgress, Warned
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import Dataset
from octasplat.engine.evaluate.ground_truth import GroundTruth, ViewGroundTruth
from octasplat.engine.evaluate.ground_truth_metrics import (
    GROUND_TRUTH_DEFINITIONS,
    environment_errors,
    finite_mean,
    fit_channel_scales,
    intersection_over_union,
    normal_angles_degrees,
    pooled_psnr,
    to_display,
    z_depth,
)
from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting.relighter import Relighter, RelitImage
from octasplat.engine.render.environment_files import read_environment
from octasplat.engine.render.renderer import RenderedImage

COVERED = 0.5
_DECIMALS = 6


@dataclass
class GroundTruthMeasures:
    """Gathers measures while views pass by one by one.

    Attributes:
        truth: what is known.
        rows: measures by view, in the order in which they came.
        light: means of the environment and of pictures in other light.
    """

    truth: GroundTruth
    rows: dict[str, dict[str, float]] = field(default_factory=dict)
    light: dict[str, object] = field(default_factory=dict)
    _albedo: list[Float32[np.ndarray, "n 3"]] = field(default_factory=list)
    _true_albedo: list[Float32[np.ndarray, "n 3"]] = field(default_factory=list)

    def add(self, name: str, image: RenderedImage, rays: ImageRays, axis_world: np.ndarray) -> None:
        """Measure a view; one that the truth does not tell of is passed over.

        Args:
            name: of the view.
            image: its render.
            rays: through its pixels.
            axis_world: unit vector along the camera's axis.

        Raises:
            DatasetError: a map of the truth cannot be used.
        """
        if name not in self.truth.views:
            return
        height, width = image.alpha.shape
        known = self.truth.view(name, (height, width))
        self.rows[name] = _geometry_metrics(image, known, rays, axis_world)
        if known.mask.any():
            self._add_materials(name, image, known)

    def add_light(
        self,
        dataset: Dataset,
        environment: EnvironmentMap,
        relighter: Relighter | None,
        progress: EventListener,
    ) -> None:
        """Measure the environment, and the scene in other light.

        Args:
            dataset: with the views that were relit.
            environment: that of the scene.
            relighter: shows the scene; None measures no pictures.
            progress: receives the progress events.

        Raises:
            ConfigError: a map of the truth cannot be used.
            DatasetError: a picture of the truth cannot be used.
        """
        frame = environment_frame(self.truth.up_world)
        if self.truth.environment is not None and not self.truth.environment.is_file():
            progress(Warned(f"{self.truth.path} names {self.truth.environment}, which is not there."))
        elif self.truth.environment is not None:
            true = EnvironmentMap(read_environment(self.truth.environment), frame)
            raw, scaled, scales = environment_errors(environment, true)
            self.light |= {
                "environment_psnr": raw,
                "environment_psnr_scaled": scaled,
                "environment_scales": [round(float(scale), _DECIMALS) for scale in scales],
            }
        names = {view.name: index for index, view in enumerate(dataset.views)}
        relit_views = [name for name in self.truth.content.relight.views if name in names]
        if relighter is None or not self.rows or not relit_views:
            return
        pictures, true_pictures, labels = [], [], []
        for folder, path in self.truth.relit_folders:
            relighter.set_environment(EnvironmentMap(read_environment(path), frame))
            for name in relit_views:
                rays = dataset.view_rays(names[name])
                pictures.append(relighter.render(rays))
                side = max(rays.height_px, rays.width_px)
                true_pictures.append(self.truth.relit_image(folder, name, side))
                labels.append((folder.name, name))
                progress(
                    PhaseProgress("evaluate", len(labels), len(relit_views) * len(self.truth.relit_folders))
                )
        if pictures:
            self.light |= measure_relit(pictures, true_pictures, labels)

    def as_dict(self) -> dict[str, object]:
        """Return the measures as ``metrics.json`` holds them: by view, and their means."""
        keys = [key for key in GROUND_TRUTH_DEFINITIONS if any(key in row for row in self.rows.values())]
        mean: dict[str, object] = {
            key: finite_mean([row[key] for row in self.rows.values() if key in row]) for key in keys
        }
        if self._albedo:
            mean |= self._albedo_mean()
        return {
            "mean": {**mean, **self.light},
            "views": {name: _round_metrics(row) for name, row in self.rows.items()},
            "definitions": dict(GROUND_TRUTH_DEFINITIONS),
        }

    def _add_materials(self, name: str, image: RenderedImage, known: ViewGroundTruth) -> None:
        for channel, true in ((ROUGHNESS, known.roughness), (METALLIC, known.metallic)):
            if true is not None and channel in image.layers:
                errors = np.abs(image.layers[channel][known.mask, 0] - true[known.mask])
                self.rows[name][f"{channel}_mae"] = float(errors.mean(dtype=float))
        if known.albedo_linear is not None and ALBEDO in image.layers:
            # Gathered, as the factors are fitted to all views together
            self._albedo.append(image.layers[ALBEDO][known.mask])
            self._true_albedo.append(known.albedo_linear[known.mask])

    def _albedo_mean(self) -> dict[str, object]:
        found, true = np.concatenate(self._albedo), np.concatenate(self._true_albedo)
        scales = fit_channel_scales(found, true, to_display)
        display, true_display = to_display(found.astype(np.float64)), to_display(true.astype(np.float64))
        return {
            "albedo_psnr": pooled_psnr(display, true_display),
            "albedo_psnr_scaled": pooled_psnr(to_display(found * scales), true_display),
            "albedo_scales": [round(float(scale), _DECIMALS) for scale in scales],
        }


def _geometry_metrics(
    image: RenderedImage, known: ViewGroundTruth, rays: ImageRays, axis_world: np.ndarray
) -> dict[str, float]:
    mask = known.mask
    covered: Bool[np.ndarray, "h w"] = image.alpha >= COVERED
    row = {"mask_iou": intersection_over_union(covered, mask)}
    if known.normal_world is not None and mask.any():
        errors = normal_angles_degrees(image.normal_world[mask], known.normal_world[mask])
        row["normal_mae"] = float(errors.mean())
    both = covered & mask
    if known.depth_z is not None and both.any():
        along = z_depth(image.depth, rays.directions_world, axis_world)
        row["depth_mae"] = float(np.abs(along - known.depth_z)[both].mean())
    return row


def _round_metrics(row: Mapping[str, float]) -> dict[str, float]:
    return {key: round(value, _DECIMALS) for key, value in row.items()}


def measure_relit(
    pictures: Sequence[RelitImage],
    true_srgb: Sequence[Float32[np.ndarray, "h w 4"]],
    names: Sequence[tuple[str, str]],
) -> dict[str, object]:
    """Measure images under other light.

    Args:
        pictures: what is measured.
        true_srgb: display colors times coverage, and coverage, of the same pictures.
        names: map and view of each.

    Returns:
        Means, means by map, and the factors.
    """
    references = [image[..., :3] for image in true_srgb]
    inside = [image[..., 3] > COVERED for image in true_srgb]
    scales = fit_channel_scales(
        np.concatenate([picture.linear[mask] for picture, mask in zip(pictures, inside, strict=True)]),
        np.concatenate([srgb_to_linear(w[mask]) for w, mask in zip(references, inside, strict=True)]),
        to_display,
    )
    raw: dict[str, list[float]] = {}
    scaled: dict[str, list[float]] = {}
    for (folder, _), picture, target in zip(names, pictures, references, strict=True):
        flat = target.reshape(-1, 3)
        for values, factor in ((raw, np.ones(3)), (scaled, scales)):
            display = picture.coverage[..., None] * to_display(picture.linear * factor)
            values.setdefault(folder, []).append(pooled_psnr(display.reshape(-1, 3), flat))
    return {
        "relight_psnr": float(np.mean([value for values in raw.values() for value in values])),
        "relight_psnr_scaled": float(np.mean([value for values in scaled.values() for value in values])),
        "relight_scales": [round(float(scale), _DECIMALS) for scale in scales],
        "relight": {
            folder: {
                "psnr": float(np.mean(raw[folder])),
                "psnr_scaled": float(np.mean(scaled[folder])),
                "views": len(raw[folder]),
            }
            for folder in raw
        },
    }
