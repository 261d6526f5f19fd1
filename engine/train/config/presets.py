"""The presets: named starting points of the settings of a training."""

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.octagon import CHI2_3_99
from octasplat.engine.settings.preset_names import PRESETS
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.config.densify import McmcConfig, RedisplatsConfig
from octasplat.engine.train.config.learning_rates import LearningRates
from octasplat.engine.train.config.loss import LossWeights
from octasplat.engine.train.config.train import TrainConfig

FLIP_NORMAL_COS = 0.5
"""Cosine beyond which normals that point away are turned, where materials are learnt."""
SHORT_TRAINING = 5000
"""Iterations of a preset without materials up to which those with them take larger steps and grow sooner."""
SHORT_MATERIAL_RATES = {"mean": 0.05, "log_scale": 0.04, "albedo": 0.08, "metallic": 0.05, "roughness": 0.05}
"""Learning rates of such a training."""
EDGE_WEIGHT = 1.0
"""``loss.edges`` with the recipe ``split_sum``."""
SHORT_DARK_METAL_WEIGHT = 0.02
"""Its ``materials.dark_metal_weight`` in such a training, in which metallic does not get far from where it
begins. In a long one rough metals that are seen too dark lose by it."""
SHORT_RESIDUAL_SHARE, LONG_RESIDUAL_SHARE = 1.6, 0.2
"""Its ``materials.residual_share`` in short and in long trainings."""
EDGE_NORMAL_WEIGHT = 0.05
"""Its ``materials.normal_weight`` and ``depth_normal_weight``: rays for edges move the Gaussians, too."""


def with_materials(config: TrainConfig, recipe: Recipe = "split_sum") -> TrainConfig:
    """Return a configuration for reflective scenes: materials are learnt, and geometry moves in small steps.

    Reflections ask for normals to within a degree, so steps are small. Points lifted from photographs that
    show reflections lie behind the surface, so there are none. In a short training small steps do not get to
    where thin parts and textures are: all but those of the rotations are larger there. Rays for edges
    (``loss.edges``), which ``split_sum`` alone has, want harmonics that show colors by direction, and
    allow more: larger rotations, weaker terms for smooth normals, twice as many Gaussians, and growth where
    the photographs differ.

    Args:
        config: of a preset.
        recipe: of the materials; the configuration does not name it.
    """
    is_short = 0 < config.iterations <= SHORT_TRAINING
    has_edge_rays = recipe == "split_sum"
    rates = {
        "quat": 1e-3,
        "mean": 0.016,
        "mean_final": 1e-3,
        "log_scale": 0.02,
        "opacity": 0.1,
        "sh_rest_ratio": 0.05,
        "scale_after": 0,
        **(SHORT_MATERIAL_RATES if is_short else {}),
        **({"quat": 3e-3} if has_edge_rays else {}),
    }
    materials: dict[str, object] = {
        "learn": True,
        # Rays may begin so near to a surface as they pass it, which normals with a side allow.
        "ray_bias": 1e-3,
        "backface_cull_distance": 1e-2,
        "depth_split": 8.0,
    }
    if has_edge_rays:
        materials.update(
            normal_weight=EDGE_NORMAL_WEIGHT,
            depth_normal_weight=EDGE_NORMAL_WEIGHT,
            dark_metal_weight=SHORT_DARK_METAL_WEIGHT if is_short else None,
            residual_share=SHORT_RESIDUAL_SHARE if is_short else LONG_RESIDUAL_SHARE,
        )
    densify = McmcConfig(
        copies="area",
        error_power=1.0 if has_edge_rays else 0.0,
        stop_fraction=0.4,
        relocate_low_weight_below=0.0,
    )
    if is_short:
        densify = densify.model_copy(update={"growth": 0.4, "stop_fraction": 0.5})
    return config.model_copy(
        update={
            "materials": config.materials.model_copy(update=materials),
            "lr": config.lr.model_copy(update=rates),
            # Gaps under things that stand on a mirror would be filled with what looks like the reflection.
            "loss": config.loss.model_copy(
                update={"free_space": 0.05, "edges": EDGE_WEIGHT if has_edge_rays else None}
            ),
            "plane_sweep_init": False,
            "normal_neighbors": 10,
            "sh_degree": min(config.sh_degree, 3 if has_edge_rays else 1),
            "sh_degree_interval": 100 if is_short and has_edge_rays else 400,
            "rays_per_batch": 8192,
            "iterations": config.iterations * 14 // 25,  # which take longer by ray, and longer with light
            "rays_per_pixel": 8,
            "pixels_per_gaussian": 25 if has_edge_rays else 50,
            "best_checkpoint_margin_db": 0.3,
            "weight_averaging_start": 0.8,
            "min_blend_weight": 0.0,
            "camera_clearance": 0.0,
            "shared_sort_until": 0.0,
            "early_stopping_db": 0.0,
            "densify": densify,
            "initial_opacity": 0.8,
            "trace": config.trace.model_copy(update={"flip_normal_cos": FLIP_NORMAL_COS}),
            "max_gaussians_auto": min(config.max_gaussians_auto * 4 // 5, 80_000),
        }
    )


def preset(name: str) -> TrainConfig:
    """Return the named preset.

    Raises:
        ConfigError: there is no such preset.
    """
    if name == "fast":
        return TrainConfig(iterations=2500, max_gaussians_auto=50_000)
    if name == "standard":
        return TrainConfig()
    if name == "high":
        return TrainConfig(rays_per_pixel=21, max_gaussians_auto=600_000)
    if name == "redisplats":
        return TrainConfig(
            iterations=10_000,
            sh_degree=0,
            rays_per_batch=8192,
            min_blend_weight=0.0,
            camera_clearance=0.0,
            shared_sort_until=0.0,
            early_stopping_db=0.0,
            repair_poses=False,
            per_view_principal_point=False,
            ray_patch_rays=1,
            pixels_per_gaussian=50,
            max_gaussians_auto=350_000,
            initial_points=30_000,
            plane_sweep_init=False,
            initial_opacity=0.1,
            lr=LearningRates(
                mean=5e-4,
                mean_final=3e-6,
                mean_unit="extent",
                axes="world",
                quat=0.01,
                log_scale=5e-3,
                opacity=0.05,
                color=1.4e-3,
                decay=0.1,
                scale_after=0,
            ),
            loss=LossWeights(l1=0.0, l2=0.8, ssim=0.1),
            trace=TraceSettings(q=CHI2_3_99, transmittance_min=0.01, second_phase_min=0.01),
            densify=RedisplatsConfig(),
        )
    listed = ", ".join(PRESETS)
    raise ConfigError(f"There is no preset called {name!r}; choose {listed}.")
