// The nearest neighbors of points, by a k-d tree that lies in one array.

const LEAF = 8;

/** A tree of `points`, three numbers each. */
export function makeTree(points) {
    const count = points.length / 3;
    const ids = Uint32Array.from({ length: count }, (_, k) => k);
    const axes = new Uint8Array(count);
    const build = (low, high) => {
        if (high - low <= LEAF) return;
        const axis = widest(points, ids, low, high), middle = (low + high) >> 1;
        select(points, ids, low, high - 1, middle, axis);
        axes[middle] = axis;
        build(low, middle);
        build(middle + 1, high);
    };
    build(0, count);

    /** The `wanted` points nearest to the point `own`, which is none of them; the nearest first. */
    function nearest(own, wanted) {
        const found = new Uint32Array(wanted), squared = new Float64Array(wanted).fill(Infinity);
        const [x, y, z] = points.subarray(3 * own, 3 * own + 3);
        const offer = (id) => {
            if (id === own) return;
            const distance = (points[3 * id] - x) ** 2 + (points[3 * id + 1] - y) ** 2 + (points[3 * id + 2] - z) ** 2;
            if (distance >= squared[wanted - 1]) return;
            let place = wanted - 1;
            for (; place > 0 && squared[place - 1] > distance; place--) [squared[place], found[place]] = [squared[place - 1], found[place - 1]];
            [squared[place], found[place]] = [distance, id];
        };
        const visit = (low, high) => {
            if (high - low <= LEAF) {
                for (let k = low; k < high; k++) offer(ids[k]);
                return;
            }
            const middle = (low + high) >> 1, axis = axes[middle];
            const beyond = points[3 * own + axis] - points[3 * ids[middle] + axis];
            offer(ids[middle]);
            if (beyond < 0) visit(low, middle);
            else visit(middle + 1, high);
            if (beyond * beyond > squared[wanted - 1]) return;
            if (beyond < 0) visit(middle + 1, high);
            else visit(low, middle);
        };
        visit(0, count);
        return { ids: found, distances: squared.map(Math.sqrt) };
    }
    return { nearest };
}

function widest(points, ids, low, high) {
    let best = 0, most = -1;
    for (let axis = 0; axis < 3; axis++) {
        let least = Infinity, largest = -Infinity;
        for (let k = low; k < high; k++) {
            const value = points[3 * ids[k] + axis];
            least = Math.min(least, value);
            largest = Math.max(largest, value);
        }
        if (largest - least > most) [best, most] = [axis, largest - least];
    }
    return best;
}

/** Puts the one that belongs at `place` there, smaller ones before it and larger ones behind it (Hoare). */
function select(points, ids, low, high, place, axis) {
    const value = (k) => points[3 * ids[k] + axis];
    while (low < high) {
        const pivot = value((low + high) >> 1);
        let i = low, j = high;
        while (i <= j) {
            while (value(i) < pivot) i += 1;
            while (value(j) > pivot) j -= 1;
            if (i > j) break;
            [ids[i], ids[j]] = [ids[j], ids[i]];
            i += 1;
            j -= 1;
        }
        if (place <= j) high = j;
        else if (place >= i) low = i;
        else return;
    }
}
