"""Metadata of a scene that rendering needs besides the Gaussians, kept through edits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from octasplat.engine.core.georeference import Georeference
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.gaussians.materials import ALBEDO
from octasplat.engine.gaussians.model import FlatGaussians


@dataclass(frozen=True)
class SceneMetadata:
    """Numbers that belong to a scene as a whole; 0 where nothing is known.

    Attributes:
        near_world: distance from a camera at which the scene begins to be seen, as in its training.
        pixel_rad: the angle of a pixel in the middle of a training view.
        turned_beyond: ``flip_normal_cos`` of :class:`octasplat.engine.trace.protocol.TraceSettings`; 0:
            normals have no side. Files have it by this name.
        origin_world: where the scene has its origin in the coordinates of its user, see
            :mod:`octasplat.engine.core.local_origin`.
        georeference: where it lies on the Earth, and how large it is; None where that is not known.
    """

    near_world: float = 0.0
    pixel_rad: float = 0.0
    turned_beyond: float = 0.0
    origin_world: Origin = NO_ORIGIN
    georeference: Georeference | None = None

    def scaled(self, factor: float) -> "SceneMetadata":
        """Return the metadata of the scene scaled by ``factor``."""
        return replace(self, near_world=self.near_world * factor)


UNKNOWN_METADATA = SceneMetadata()


def merge_metadata(scenes: Sequence[tuple[FlatGaussians, SceneMetadata]]) -> SceneMetadata:
    """Return the metadata of merged scenes: what holds for each of them, about the origin of the first.

    Scenes are put together as they stand, so that a georeference holds if no scene has another. Whether
    normals have a side is for those to say that have materials, as no others are lit by them.
    """
    known = [facts.georeference for _, facts in scenes if facts.georeference is not None]
    # scene files keep neither the method nor the residuals
    is_common = bool(known) and all(place.is_same_place(known[0]) for place in known[1:])
    lit = [facts.turned_beyond for gaussians, facts in scenes if ALBEDO in gaussians.channels]
    return SceneMetadata(
        near_world=min(facts.near_world for _, facts in scenes),
        pixel_rad=min(facts.pixel_rad for _, facts in scenes),
        turned_beyond=min(lit, default=0.0),
        origin_world=scenes[0][1].origin_world,
        georeference=known[0] if is_common else None,
    )
