"""Settings of a synthetic dataset; imports nothing heavy, so that a front end can use it."""

from dataclasses import asdict, dataclass

from octasplat.engine.core.errors import ConfigError

SCENES = ("still_life", "street")
CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class SyntheticDatasetConfig:
    """Settings of a generated scene; on one machine equal settings give equal files, byte for byte.

    Attributes:
        views: Number of photographs: on three rings around the table, or on two walks along the street.
        width_px: Width of a photograph.
        height_px: Height of a photograph.
        samples_per_side: A pixel is the mean of this number squared of display colors, on a regular grid.
        points: Number of points in the COLMAP model.
        seed: Seeds the jitter of the cameras and the choice of the points; the objects stay the same.
        camera_model: COLMAP's name of the lens, one of ``CAMERA_MODELS``; it distorts the
            photographs accordingly.
        transparent: Write RGBA photographs (straight alpha) that show the table and its objects only, with
            their coverage of each pixel as alpha. Of the street all but the sky is shown.
        with_masks: Also write the object masks where a reconstruction looks for them: ``masks/``.
        scene: One of ``SCENES``: a still life on a table, or a street for captures of many views.
        houses: Of the street: houses on each side, each of which takes 14 m of its length.

    Raises:
        ConfigError: If a value is out of range.
    """

    views: int = 40
    width_px: int = 320
    height_px: int = 240
    samples_per_side: int = 3
    points: int = 10_000
    seed: int = 0
    camera_model: str = "PINHOLE"
    transparent: bool = False
    with_masks: bool = False
    scene: str = "still_life"
    houses: int = 8

    def __post_init__(self) -> None:
        ranges = {
            "views": (3, 100_000),
            "width_px": (8, 8192),
            "height_px": (8, 8192),
            "samples_per_side": (1, 16),
            "points": (1, 1_000_000),
            "seed": (0, 2**32 - 1),
            "houses": (1, 24),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(
                    f"Generated scene: {name} is {value}, but must lie between {low} and {high}."
                )
        if self.scene not in SCENES:
            names = ", ".join(SCENES)
            raise ConfigError(f"Generated scene: scene is {self.scene!r}, but must be one of {names}.")
        if self.camera_model not in CAMERA_MODELS:
            names = ", ".join(CAMERA_MODELS)
            raise ConfigError(
                f"Generated scene: camera_model is {self.camera_model!r}, but must be one of {names}."
            )

    @property
    def objects_only(self) -> bool:
        """Return whether only the table and its objects are reconstructed; sparse points lie on them."""
        return self.transparent or self.with_masks

    def as_dict(self) -> dict[str, object]:
        """Return the settings as JSON-ready values."""
        return asdict(self)
