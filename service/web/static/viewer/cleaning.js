// What crop and clean would remove, for a look before they are asked for; engine/edit/cleaning.py has the rules.

import { makeTree } from "./nearest.js";
import { frameOfView, isInFrame } from "./sorting.js";

const MAX_LINK = 8;
export const REASONS = ["outside", "faint", "large", "near", "unseen", "floating"];

/**
 * Marks with 1 what would be removed, and counts it by the first reason that holds; arrays are as of ply.js,
 * views as of cameras.json.
 *
 * @param {{box: ?number[], clean: ?{min_opacity, max_scale, camera_clearance, min_views, floaters, min_group, link, neighbors}}} wanted
 *   the box of a crop, and options of clean; without one of them that is left out.
 */
export function removedBy({ count, geometry, bounds }, views, { box, clean }) {
    const removed = new Uint8Array(count), counts = Object.fromEntries(REASONS.map((reason) => [reason, 0]));
    const judge = thresholds(geometry, bounds, views.filter((view) => !view.held_out), box, clean);
    for (let i = 0; i < count; i++) {
        const reason = judge(i);
        if (reason === null) continue;
        removed[i] = 1;
        counts[reason] += 1;
    }
    if (clean?.floaters) {
        for (const i of floaters(geometry, bounds, removed, clean)) {
            removed[i] = 1;
            counts.floating += 1;
        }
    }
    return { removed, counts, kept: count - Object.values(counts).reduce((sum, number) => sum + number, 0) };
}

function thresholds(geometry, bounds, views, box, clean) {
    const frames = clean?.min_views ? views.map((view) => frameOfView(view, 1)) : [];
    const least = Math.min(clean?.min_views ?? 0, frames.length);
    const zones = clean?.camera_clearance ? views.map(({ position, nearest_world: nearest }) => [position, (clean.camera_clearance * nearest) ** 2]).filter(([, radius]) => radius > 0) : [];
    return (i) => {
        const [x, y, z, opacity] = geometry.subarray(12 * i, 12 * i + 4);
        if (box && !(x >= box[0] && y >= box[1] && z >= box[2] && x <= box[3] && y <= box[4] && z <= box[5])) return "outside";
        if (!clean) return null;
        if (opacity < clean.min_opacity) return "faint";
        if (clean.max_scale && bounds[i] > clean.max_scale) return "large";
        if (zones.some(([[a, b, c], radius]) => (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < radius)) return "near";
        let seen = 0;
        for (let v = 0; v < frames.length && seen < least; v++) seen += isInFrame(frames[v], x, y, z) ? 1 : 0;
        return seen < least ? "unseen" : null;
    };
}

/** Numbers of those in small groups; a group is held together by Gaussians as near as they are large. */
function floaters(geometry, bounds, removed, { link, min_group: least, neighbors }) {
    const rows = Uint32Array.from(removed.keys()).filter((i) => !removed[i]);
    const count = rows.length, wanted = Math.min(neighbors, count - 1);
    if (wanted < 1) return [];
    const points = new Float64Array(3 * count);
    rows.forEach((i, k) => points.set(geometry.subarray(12 * i, 12 * i + 3), 3 * k));
    const tree = makeTree(points), near = new Uint32Array(count * wanted), distances = new Float64Array(count * wanted);
    const extents = new Float64Array(count);
    for (let k = 0; k < count; k++) {
        const found = tree.nearest(k, wanted);
        for (let j = 0; j < wanted; j++) [near[k * wanted + j], distances[k * wanted + j]] = [found.ids[j], found.distances[j]];
        const middle = wanted >> 1;
        const median = wanted % 2 ? found.distances[middle] : (found.distances[middle - 1] + found.distances[middle]) / 2;
        extents[k] = Math.min(bounds[rows[k]], MAX_LINK * median);
    }
    const group = Uint32Array.from({ length: count }, (_, k) => k);
    const root = (k) => {
        while (group[k] !== k) k = group[k] = group[group[k]];
        return k;
    };
    for (let e = 0; e < near.length; e++) {
        const k = Math.floor(e / wanted);
        if (distances[e] <= link * (extents[k] + extents[near[e]])) group[root(k)] = root(near[e]);
    }
    const sizes = new Uint32Array(count);
    for (let k = 0; k < count; k++) sizes[root(k)] += 1;
    const enough = Math.min(least, sizes.reduce((most, size) => Math.max(most, size), 0));
    return [...rows].filter((_i, k) => sizes[root(k)] < enough);
}
