// What a ray through a pixel shows, as the scene is drawn: octagons, nearest first, until half the light is stopped.

const COSINE = Math.cos(Math.PI / 8);
const HALF = 0.5;
const LEAST_SHARE = 0.05; // of the light; what stops less cannot be meant

/**
 * The point at which half of a ray's light has been stopped, or where less is, that at which most of it was;
 * null where there is nothing. Arrays are as of ply.js, `q` is the squared radius of an octagon in standard deviations, and `hidden` has 1 for Gaussians to pass by.
 */
export function pick({ count, geometry }, origin, direction, q, hidden = null) {
    const hits = [];
    for (let i = 0; i < count; i++) {
        if (hidden?.[i]) continue;
        const g = 12 * i, limit = q + 2 * Math.log(geometry[g + 3]); // as shaders.js draws it
        if (!(limit > 0)) continue;
        const ax = geometry[g + 4], ay = geometry[g + 5], az = geometry[g + 6], bx = geometry[g + 8], by = geometry[g + 9], bz = geometry[g + 10];
        const nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        const slope = nx * direction[0] + ny * direction[1] + nz * direction[2];
        if (slope === 0) continue;
        const mx = geometry[g] - origin[0], my = geometry[g + 1] - origin[1], mz = geometry[g + 2] - origin[2];
        const t = (nx * mx + ny * my + nz * mz) / slope;
        if (!(t > 0)) continue;
        const px = t * direction[0] - mx, py = t * direction[1] - my, pz = t * direction[2] - mz;
        const u = (px * ax + py * ay + pz * az) / (ax * ax + ay * ay + az * az), v = (px * bx + py * by + pz * bz) / (bx * bx + by * by + bz * bz);
        const squared = u * u + v * v;
        if (!(squared < limit) || !isInOctagon(u, v, Math.sqrt(limit))) continue;
        hits.push([t, geometry[g + 3] * Math.exp(-0.5 * squared)]);
    }
    hits.sort((one, other) => one[0] - other[0]);
    let light = 1, most = LEAST_SHARE, place = null;
    for (const [t, alpha] of hits) {
        if (alpha * light > most) [most, place] = [alpha * light, t];
        light *= 1 - alpha;
        if (light > HALF) continue;
        place = t;
        break;
    }
    return place === null ? null : direction.map((value, k) => origin[k] + place * value);
}

function isInOctagon(u, v, reach) {
    const inner = reach * COSINE;
    for (let k = 0; k < 8; k++) {
        const angle = ((2 * k + 1) * Math.PI) / 8;
        if (u * Math.cos(angle) + v * Math.sin(angle) > inner) return false;
    }
    return true;
}
