// Back-to-front order by a counting sort of the depths' bits.

const BUCKETS = 1 << 16;

/** Makes a function that orders Gaussians whose arrays are as of ply.js. */
export function makeSorter({ count, geometry, bounds }) {
    const depths = new Float32Array(count);
    const keys = new Uint32Array(depths.buffer);
    const first = new Uint32Array(count);
    const low = new Uint32Array(BUCKETS), high = new Uint32Array(BUCKETS);

    /**
     * Writes the numbers of the Gaussians, the farthest first, and returns how many there are; those wholly
     * behind the camera are left out. `reach` is how many standard deviations an octagon reaches at most.
     */
    return function sort(position, forward, reach, order) {
        low.fill(0);
        high.fill(0);
        let seen = 0;
        for (let i = 0; i < count; i++) {
            const g = i * 12;
            const depth = (geometry[g] - position[0]) * forward[0] + (geometry[g + 1] - position[1]) * forward[1] + (geometry[g + 2] - position[2]) * forward[2];
            if (!(depth > -bounds[i] * reach)) continue;
            // The bits of positive numbers are ordered as the numbers are; turned over, the farthest is first.
            depths[seen] = Math.max(depth, 1e-30);
            const key = ~keys[seen] >>> 0;
            keys[seen] = key;
            order[seen] = i;
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
        const ids = order.slice(0, seen);
        for (let k = 0; k < seen; k++) {
            const i = first[k];
            order[high[keys[i] >>> 16]++] = ids[i];
        }
        return seen;
    };
}
