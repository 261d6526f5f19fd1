"""Resource demands of job options, and the limits that a service sets."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

LIMIT_UNITS: Mapping[str, str] = {
    "iterations": "iterations",
    "gaussians": "Gaussians",
    "rays": "rays",
    "side_px": "pixels of a side",
    "exports": "files",
    "render_pixels": "pixels of all images together",
    "render_paths": "paths of light of all images together",
    "workspace_bytes": "bytes of disk for its work",
}
"""Names of the ceilings, as the settings have them with ``max_`` before, and what they count."""


@dataclass(frozen=True)
class ResourceDemand:
    """An amount of a resource that may be limited.

    Attributes:
        path: where the options say so, with dots.
        resource: name in :data:`LIMIT_UNITS`.
        amount: how much.
    """

    path: str
    resource: str
    amount: int


@dataclass(frozen=True)
class ExceededLimit:
    """A demand that exceeds its limit."""

    demand: ResourceDemand
    limit: int

    @property
    def sentence(self) -> str:
        """Return what is exceeded and what is allowed, as a sentence for the user."""
        demand = self.demand
        # Numbers of twenty digits are nobody's wish; to write them all out helps nobody either.
        amount = f"{demand.amount:,}" if demand.amount < 10**15 else f"{demand.amount:.0e}"
        what = f"{amount} {LIMIT_UNITS[demand.resource]}"
        return f"{demand.path} asks for {what}; at most {self.limit:,} are allowed here."


def exceeded_limits(demands: Iterable[ResourceDemand], limits: Mapping[str, int]) -> list[ExceededLimit]:
    """Return the demands above their limits."""
    return [
        ExceededLimit(demand, limits[demand.resource])
        for demand in demands
        if demand.resource in limits and demand.amount > limits[demand.resource]
    ]
