"""What options ask for that can be too much for a service, and the ceilings that it sets."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

CEILINGS: Mapping[str, str] = {
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
class Demand:
    """So much of something that has a ceiling.

    Attributes:
        path: where the options say so, with dots.
        of: name in :data:`CEILINGS`.
        amount: how much.
    """

    path: str
    of: str
    amount: int


@dataclass(frozen=True)
class Excess:
    """A demand that is too high, and how high it may be."""

    demand: Demand
    ceiling: int

    @property
    def sentence(self) -> str:
        """What is wrong and what is allowed, for the user."""
        demand = self.demand
        # Numbers of twenty digits are nobody's wish; to write them all out helps nobody either.
        amount = f"{demand.amount:,}" if demand.amount < 10**15 else f"{demand.amount:.0e}"
        what = f"{amount} {CEILINGS[demand.of]}"
        return f"{demand.path} asks for {what}; at most {self.ceiling:,} are allowed here."


def excesses(demands: Iterable[Demand], ceilings: Mapping[str, int]) -> list[Excess]:
    """The demands above their ceilings."""
    return [
        Excess(demand, ceilings[demand.of])
        for demand in demands
        if demand.of in ceilings and demand.amount > ceilings[demand.of]
    ]
