// Back-to-front order by a counting sort of the depths' bits.

const BUCKETS = 1 << 16;
const MAX_JUDGES = 64;
const MIN_SHARE_OF_VIEWS = 0.03;
const MAX_HIDDEN_SHARE = 0.6;
const SHARE_OF_USUAL = 0.1; // of the photographs that show a Gaussian of the middle by their number
const LEAST_USUAL = 8; // where that are fewer of the known ones, they say nothing of single Gaussians
const MAX_SAMPLES = 1000;
const FRAME_MARGIN = 1.1;

/**
 * Makes a function that orders Gaussians whose arrays are as of ply.js; `views` are photographs as of
 * cameras.json. What too few of them show is left out (`shown` is 0): nothing but streaks is known of it.
 */
export function makeSorter({ count, geometry, bounds, views = [], shown = shownBy(count, geometry, views) }) {
    // Heaviest first, so that the first ones are the best part of a scene to draw alone.
    const numbers = byWeight(count, geometry, shown);
    const all = numbers.length;
    const places = new Float32Array(all * 4);
    for (let k = 0; k < all; k++) {
        const g = 12 * numbers[k];
        places.set([geometry[g], geometry[g + 1], geometry[g + 2], bounds[numbers[k]]], 4 * k);
    }
    const depths = new Float32Array(all);
    const keys = new Uint32Array(depths.buffer);
    const first = new Uint32Array(all), ids = new Uint32Array(all);
    const low = new Uint32Array(BUCKETS), high = new Uint32Array(BUCKETS);

    /**
     * Writes the numbers of the Gaussians, the farthest first, and returns how many there are; those wholly
     * behind the camera are left out. `reach` is how many standard deviations an octagon reaches at most; of
     * all, the `limit` heaviest are taken; those that `hidden` marks are left out.
     */
    return function sort(position, forward, reach, order, limit = all, hidden = null) {
        low.fill(0);
        high.fill(0);
        const taken = Math.min(limit, all);
        let seen = 0;
        for (let i = 0; i < taken; i++) {
            if (hidden?.[numbers[i]]) continue;
            const g = i * 4;
            const depth = (places[g] - position[0]) * forward[0] + (places[g + 1] - position[1]) * forward[1] + (places[g + 2] - position[2]) * forward[2];
            if (!(depth > -places[g + 3] * reach)) continue;
            // The bits of positive numbers are ordered as the numbers are; turned over, the farthest is first.
            depths[seen] = Math.max(depth, 1e-30);
            const key = ~keys[seen] >>> 0;
            keys[seen] = key;
            ids[seen] = numbers[i];
            low[key & 0xffff] += 1;
            high[key >>> 16] += 1;
            seen += 1;
        }
        let lowSum = 0, highSum = 0;
        for (let b = 0; b < BUCKETS; b++) {
            const l = low[b], h = high[b];
            low[b] = lowSum;
            high[b] = highSum;
            lowSum += l;
            highSum += h;
        }
        for (let i = 0; i < seen; i++) first[low[keys[i] & 0xffff]++] = i;
        for (let k = 0; k < seen; k++) {
            const i = first[k];
            order[high[keys[i] >>> 16]++] = ids[i];
        }
        return seen;
    };
}

/**
 * For each Gaussian 1 where enough photographs have its middle in their frame, else 0. Some of many photographs
 * judge first; all of them judge what these do not see, as each shows but a small part of a large scene.
 */
export function shownBy(count, geometry, views) {
    const shown = new Uint8Array(count).fill(1);
    const every = views.map((view) => frameOfView(view, FRAME_MARGIN));
    const step = Math.max(1, Math.ceil(views.length / MAX_JUDGES));
    const judges = every.filter((_frame, k) => k % step === 0);
    if (judges.length < 3) return shown;
    const votes = (frames, i, most = Infinity) => {
        let sum = 0;
        for (let v = 0; v < frames.length && sum < most; v++) sum += isInFrame(frames[v], geometry[12 * i], geometry[12 * i + 1], geometry[12 * i + 2]) ? 1 : 0;
        return sum;
    };
    const least = Math.max(2, MIN_SHARE_OF_VIEWS * judges.length);
    let leastOfAll = Infinity;
    if (step > 1) {
        const usual = usualOf(count, (i) => votes(every, i));
        if (usual < LEAST_USUAL) return shown;
        leastOfAll = Math.max(2, Math.min(MIN_SHARE_OF_VIEWS * every.length, SHARE_OF_USUAL * usual));
    }
    let hidden = 0;
    for (let i = 0; i < count; i++) {
        if (votes(judges, i, least) >= least || (step > 1 && votes(every, i, leastOfAll) >= leastOfAll)) continue;
        shown[i] = 0;
        hidden += 1;
    }
    return hidden > MAX_HIDDEN_SHARE * count ? shown.fill(1) : shown;
}

/** The median of a number of Gaussians, from some of them. */
function usualOf(count, numberOf) {
    const step = Math.max(1, Math.floor(count / MAX_SAMPLES));
    const numbers = Array.from({ length: Math.ceil(count / step) }, (_, k) => numberOf(k * step)).sort((a, b) => a - b);
    return numbers[numbers.length >> 1] ?? 0;
}

/** The image of a view as of cameras.json, `margin` times as large; a panorama shows everything. */
export function frameOfView({ position, forward, up, fov_y_degrees: fovY, aspect, panorama = false }, margin) {
    const right = [forward[1] * up[2] - forward[2] * up[1], forward[2] * up[0] - forward[0] * up[2], forward[0] * up[1] - forward[1] * up[0]];
    const tangent = Math.tan((fovY * Math.PI) / 360) * margin;
    return { position, forward, up, right, y: tangent, x: tangent * aspect, panorama };
}

/** Whether a point lies in such an image. */
export function isInFrame({ position: p, forward: f, up: u, right: r, x, y, panorama }, a, b, c) {
    if (panorama) return true;
    const dx = a - p[0], dy = b - p[1], dz = c - p[2];
    const depth = dx * f[0] + dy * f[1] + dz * f[2];
    return depth > 0 && Math.abs(dx * r[0] + dy * r[1] + dz * r[2]) < x * depth && Math.abs(dx * u[0] + dy * u[1] + dz * u[2]) < y * depth;
}

/** Numbers of the Gaussians that are shown, the heaviest first: by opacity and the square root of the area. */
function byWeight(count, geometry, shown) {
    const weights = new Float32Array(count), numbers = [];
    for (let i = 0; i < count; i++) {
        if (!shown[i]) continue;
        const g = 12 * i;
        const [ax, ay, az, bx, by, bz] = [geometry[g + 4], geometry[g + 5], geometry[g + 6], geometry[g + 8], geometry[g + 9], geometry[g + 10]];
        const area = Math.hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx);
        weights[i] = geometry[g + 3] * Math.sqrt(area);
        numbers.push(i);
    }
    return Uint32Array.from(numbers).sort((i, k) => weights[k] - weights[i] || i - k);
}
