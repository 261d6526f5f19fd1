"""Glass in glass: which medium counts where several overlap, and surfaces that light does not notice there.

A path keeps a list of the glass that it is inside. Where several overlap, that of the highest priority is all
there is, of equal ones the one that was entered last; a surface of any other lies within it and is passed as
if it were not there: "Simple Nested Dielectrics in Ray Traced Images" (Schmidt and Budge 2002). Glass without
a priority is in no list, and stands in air.
"""

import numpy as np
from jaxtyping import Int32

from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays
from octasplat.engine.pathtracing.kernels.path_args import MAX_NESTED
from octasplat.engine.trace.kernels.native import njit_no_refcount

AIR = -1


@njit_no_refcount(forceinline=True)
def is_nested(materials: MaterialArrays, m: int) -> bool:
    """Return whether a material is glass with a priority."""
    return materials.priorities[m] >= 0


@njit_no_refcount(forceinline=True)
def medium_of(materials: MaterialArrays, media: Int32[np.ndarray, " d"]) -> int:
    """Return the material that counts among those that a path is inside, -1 for air."""
    found = AIR
    for place in range(MAX_NESTED):
        m = media[place]
        if m >= 0 and (found < 0 or materials.priorities[m] >= materials.priorities[found]):
            found = m
    return found


@njit_no_refcount(forceinline=True)
def index_of(materials: MaterialArrays, medium: int) -> float:
    """Return the index of refraction of a medium."""
    return materials.iors[medium] if medium >= 0 else 1.0


@njit_no_refcount(forceinline=True)
def is_hidden(materials: MaterialArrays, media: Int32[np.ndarray, " d"], m: int, is_entering: bool) -> bool:
    """Return whether a surface of the glass ``m`` lies within other glass that counts instead."""
    medium = medium_of(materials, media)
    if medium < 0:
        return False
    if is_entering:
        return materials.priorities[medium] > materials.priorities[m]
    return medium != m


@njit_no_refcount(forceinline=True)
def cross_surface(media: Int32[np.ndarray, " d"], m: int, is_entering: bool) -> None:
    """Put the glass ``m`` behind the others in the list of a path, or take it out of it.

    Of more than :data:`MAX_NESTED` that overlap the last are left out.
    """
    if is_entering:
        for place in range(MAX_NESTED):
            if media[place] < 0:
                media[place] = m
                return
        return
    for place in range(MAX_NESTED - 1, -1, -1):
        if media[place] == m:
            for later in range(place, MAX_NESTED - 1):
                media[later] = media[later + 1]
            media[MAX_NESTED - 1] = AIR
            return


@njit_no_refcount(forceinline=True)
def copy_media(source: Int32[np.ndarray, " d"], target: Int32[np.ndarray, " d"]) -> bool:
    """Copy a list; return whether it was another."""
    changed = False
    for place in range(MAX_NESTED):
        changed = changed or target[place] != source[place]
        target[place] = source[place]
    return changed
