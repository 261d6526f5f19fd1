r"""Packets whose rays see their Gaussians in one order, for training.

A ray's own order of hits is exact, and most of what a hit costs: each ray tests, sorts and keeps its own.
Rays of a small packet meet much the same Gaussians in much the same order. Here the candidates of a packet
are sorted once, by the distance at which its axis meets them (the first steps of
:mod:`octasplat.engine.trace.cpu.kernels_packet`), and all of its rays composite them in that order, sixteen
rays at a time (:mod:`octasplat.engine.trace.cpu.kernels_sixteen`), until none has light left:

    for each candidate, front to back        rays of the packet, sixteen to a vector
        alphas of the rays that may meet it   [. . a a a . . .]   octagon, distance and limits as ever
        its colour, if any ray does           c
        what the rays see                     rgb += T a c,  T *= 1 - a

Kept of it are the Gaussians that were met, as lines, and which rays met them. The backward pass goes through
the same list from the back, finds the alphas again, and ends with one row of moments for each Gaussian of the
packet, like the other one's.

Not done: where octagons cross, and where a packet sees them obliquely, some of its rays composite in the
wrong order; what that costs is in docs/experiments.md, "One order". Nor is there a second phase, are there
features, or gradients by depths and normals; :class:`octasplat.engine.trace.cpu.tracer.CpuTracer` says when
this is used.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt64

from octasplat.engine.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels_packet import (
    AHEAD,
    RECORD_BYTES,
    SHOWN,
    START_ROOM,
    aligned_doubles,
    find_candidates,
    new_candidates,
    write_row,
)
from octasplat.engine.trace.cpu.kernels_packet_forward import show
from octasplat.engine.trace.cpu.kernels_packet_order import sort_by_distance
from octasplat.engine.trace.cpu.kernels_packet_walk import new_pyramid, new_walk
from octasplat.engine.trace.cpu.kernels_rays import ray_limits, ray_origin, ray_slopes
from octasplat.engine.trace.cpu.kernels_sixteen import (
    COLOUR,
    COUNT,
    DEPTH,
    GROUPS,
    LEFT,
    LINE,
    MEDIAN,
    MET_ROWS,
    NORMAL_0,
    PER_AXIS,
    RAY_ROWS,
    RAYS,
    RED,
    SEEN_ROWS,
    SIXTEEN,
    SLOPE_A,
    SLOPE_B,
    T_MAX,
    T_MIN,
    meet_group,
    show_group,
)
from octasplat.engine.trace.kernels_native import (
    ask_for,
    lean,
    next_from_counter,
    prefetch,
    taken_from_counter,
)

GROUP = np.uint64((1 << SIXTEEN) - 1)
NUMBER = np.uint64(0xFFFFFFFF)


class View(NamedTuple):
    """Memory of a thread for a packet: rows of the sixteen-ray kernels, and what it meets.

    ``met_ids``, ``met_bits`` and ``lines`` have room for as many Gaussians as there are candidates.
    """

    rays: Float32[np.ndarray, "5 64"]
    seen: Float32[np.ndarray, "10 64"]
    met: Float32[np.ndarray, "2 64"]
    normal: Float32[np.ndarray, "16"]
    shown: Float64[np.ndarray, "8"]
    basis: Float64[np.ndarray, "16"]
    met_ids: Int32[np.ndarray, " c"]
    met_bits: UInt64[np.ndarray, " c"]
    lines: Float32[np.ndarray, "c 16 1"]


@device_function(error_model="numpy")
def aligned_rows(rows, lanes):
    """Rows of so many float32, a multiple of sixteen, on cache lines."""
    return aligned_doubles(rows * lanes // 2).view(np.float32).reshape((rows, lanes))


@device_function(error_model="numpy")
def new_view(room):
    """Memory for packets of up to ``room`` candidates, one after another."""
    return View(
        aligned_rows(RAY_ROWS, RAYS),
        aligned_rows(SEEN_ROWS, RAYS),
        aligned_rows(MET_ROWS, RAYS),
        np.zeros(SIXTEEN, np.float32),
        np.empty(SHOWN, np.float64),
        np.empty(16, np.float64),
        np.empty(room, np.int32),
        np.empty(room, np.uint64),
        aligned_rows(room, LINE).reshape((room, LINE, 1)),
    )


@lean(fastmath={"contract"})
def write_ray_rows(rays, first, last, frame, rows):
    """The rays ``first`` to ``last``, at most 64, in their packet's frame; lanes behind them see nothing."""
    for r in range(first, last):
        k = r - first
        rows[SLOPE_A, k], rows[SLOPE_B, k], rows[PER_AXIS, k] = ray_slopes(rays, r, frame)
        rows[T_MIN, k], rows[T_MAX, k] = ray_limits(rays, r)
    for k in range(last - first, RAYS):
        rows[SLOPE_A, k] = rows[SLOPE_B, k] = rows[T_MIN, k] = rows[T_MAX, k] = np.float32(0.0)
        rows[PER_AXIS, k] = np.float32(1.0)


@lean(forceinline=True)
def group_bits(bits, group):
    """Those of a group of rays."""
    return np.int64((bits >> np.uint64(SIXTEEN * group)) & GROUP)


@lean(fastmath={"contract"})
def see(first, last, origin, frame, forward, order, candidates, count, view):
    """Let the rays ``first`` to ``last`` see the sorted candidates; returns how many were met."""
    scene, limits, seen = forward.scene, forward.limits, view.seen
    keys, found, masks = candidates.keys, candidates.found, candidates.masks
    records_at, sh_at = scene.records.ctypes.data, scene.sh.ctypes.data
    sh_bytes = scene.sh.shape[1] * 12
    rays_at, seen_at, met_at = view.rays.ctypes.data, seen.ctypes.data, view.met.ctypes.data
    least, most = np.float32(limits.eps1), np.float32(limits.max_hits)
    alpha_max = np.float32(limits.alpha_max)
    write_ray_rows(forward.rays, first, last, frame, view.rays)
    seen[:, :] = np.float32(0.0)
    seen[LEFT, : last - first] = np.float32(1.0)
    alive = ~np.uint64(0) >> np.uint64(RAYS - (last - first))
    met = 0
    for k in range(count):
        if k + AHEAD < count:
            which = np.int64(keys[k + AHEAD] & NUMBER)
            if masks[which] & alive != 0:
                ahead = order[found[which]]
                prefetch(records_at + ahead * RECORD_BYTES)
                ask_for(sh_at + ahead * sh_bytes, sh_bytes)
        which = np.int64(keys[k] & NUMBER)
        may = masks[which] & alive
        if may == 0:
            continue
        i, line = order[found[which]], view.lines[met]
        line_at = line.ctypes.data
        write_row(line, 0, scene.records[i], origin, frame)
        bits = np.uint64(0)
        for group in range(GROUPS):
            if group_bits(may, group) != 0:
                here = meet_group(line_at, rays_at, seen_at, met_at, group, least, alpha_max, most)
                bits |= np.uint64(here) << np.uint64(SIXTEEN * group)
        if bits == 0:
            continue
        show(view.shown, i, scene, limits, origin, view.basis)
        for axis in range(3):
            line[COLOUR + axis, 0], view.normal[axis] = view.shown[axis], view.shown[4 + axis]
        for group in range(GROUPS):
            here = group_bits(bits, group)
            if here != 0:
                after = show_group(
                    line_at, view.normal.ctypes.data, seen_at, met_at, group, here, least
                )  # fmt: skip
                at = np.uint64(SIXTEEN * group)
                alive &= np.uint64(after) << at | ~(GROUP << at)
        view.met_ids[met], view.met_bits[met] = i, bits
        met += 1
        if alive == 0:
            break
    return met


@lean()
def write_seen(first, last, seen, out):
    """What the rays ``first`` to ``last`` have seen."""
    for r in range(first, last):
        k = r - first
        out.counts[r] = np.int32(seen[COUNT, k])
        out.transmittance[r] = seen[LEFT, k]
        out.depth_sum[r], out.depth_median[r] = seen[DEPTH, k], seen[MEDIAN, k]
        for axis in range(3):
            out.rgb[r, axis], out.normal[r, axis] = seen[RED + axis, k], seen[NORMAL_0 + axis, k]


@lean()
def keep(packet, met, frame, view, kept, start):
    """Keep what a packet has met from place ``start`` on."""
    kept.starts[packet], kept.counts[packet] = start, met
    for k in range(9):
        kept.frames[packet, k] = frame[k]
    for k in range(met):
        kept.ids[start + k], kept.bits[start + k] = view.met_ids[k], view.met_bits[k]
        for word in range(LINE):
            kept.lines[start + k, word] = view.lines[k, word, 0]


@kernel(error_model="numpy")
def see_packets(forward, packets, tree, kept, counter, places):
    """Trace packets until the ``counter`` has passed the last.

    What they meet is kept where ``places``, a counter too, says; where that is beyond the room of ``kept``
    it is only counted.
    """
    pyramid, walk = new_pyramid(), new_walk()
    candidates, view = new_candidates(START_ROOM), new_view(START_ROOM)
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        first, last = packets[packet, 0], packets[packet, 1]
        candidates, count = find_candidates(forward.rays, first, last, tree, pyramid, walk, candidates)
        if count > len(view.met_ids):
            view = new_view(len(candidates.found))
        sort_by_distance(candidates, count, walk.histogram)
        origin = ray_origin(forward.rays, first)
        met = see(first, last, origin, pyramid.frame, forward, tree.order, candidates, count, view)
        write_seen(first, last, view.seen, forward.out)
        if forward.recording:
            start = taken_from_counter(places.ctypes.data, met)
            if start + met <= len(kept.ids):
                keep(packet, met, pyramid.frame, view, kept, start)
