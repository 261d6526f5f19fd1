// A map of light (Radiance HDR) to what the split sum asks of it: blurred levels, the irradiance, and the table
// of the BRDF's half. The same as engine/shading does, in 128 rows.

import { toHalf } from "./half.js";

const HEIGHT = 128;
const ROUGHNESSES = [0.05, 0.15, 0.3, 0.5, 0.75, 1];
const HALVINGS = [0, 1, 2, 3, 3, 3, 3]; // of each level; the irradiance comes last
const SOURCES = [0, 1, 2, 2, 3, 3, 3]; // of the map that it is made from
const LEAST = [0, 3e-3, 3e-3, 1e-3, 1e-3, 1e-3, 0];
const TABLE = { rows: 32, columns: 64, samples: 128 };
const MAX_SIDE = 1 << 14;

/** The linear radiance in a file: {width, height, data} with three numbers a texel, rows from up to down. */
export function readHdr(buffer) {
    const bytes = new Uint8Array(buffer);
    const text = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 12));
    const size = /\n\n-Y (\d+) \+X (\d+)\n/.exec(text);
    const isOther = /^FORMAT=(?!32-bit_rle_rgbe$)/m.test(text.slice(0, size?.index)); // such as XYZ colors
    if (!text.startsWith("#?") || !size || isOther) throw new Error("The 3D view takes light from Radiance HDR files only.");
    const height = Number(size[1]), width = Number(size[2]);
    if (width > MAX_SIDE || height > MAX_SIDE) throw new Error("This map is too large for the 3D view.");
    const data = new Float32Array(3 * width * height), row = new Uint8Array(4 * width);
    let at = size.index + size[0].length;
    for (let y = 0; y < height; y++) {
        if (width >= 8 && width < 32768 && bytes[at] === 2 && bytes[at + 1] === 2 && (bytes[at + 2] << 8 | bytes[at + 3]) === width) {
            at += 4;
            for (let channel = 0; channel < 4; channel++) {
                for (let x = 0; x < width;) {
                    const count = bytes[at++];
                    if (!(count & 127 || count === 128) || x + (count & 127 || 128) > width && count <= 128) throw new Error("This map is damaged.");
                    if (count > 128) {
                        const value = bytes[at++];
                        for (let k = count - 128; k > 0 && x < width; k--, x++) row[channel * width + x] = value;
                    } else for (let k = count; k > 0; k--, x++) row[channel * width + x] = bytes[at++];
                }
            }
            for (let x = 0; x < width; x++) texel(data, 3 * (y * width + x), row[x], row[width + x], row[2 * width + x], row[3 * width + x]);
        } else {
            for (let x = 0; x < width; x++, at += 4) texel(data, 3 * (y * width + x), bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]);
        }
        if (at > bytes.length) throw new Error("This map is cut short.");
    }
    return { width, height, data };
}

function texel(data, place, red, green, blue, exponent) {
    const factor = exponent ? 2 ** (exponent - 136) : 0;
    data[place] = red * factor;
    data[place + 1] = green * factor;
    data[place + 2] = blue * factor;
}

/** Levels as textures take them, {width, height, data}: half-precision red, green, blue and 0. */
export function levelsOf(map) {
    const halved = [resampled(map, HEIGHT)];
    for (let k = 0; k < 3; k++) halved.push(half(halved[k], HEIGHT >> k));
    return HALVINGS.map((halving, level) => {
        const height = HEIGHT >> halving, source = HEIGHT >> SOURCES[level];
        const values = level ? blurred(halved[SOURCES[level]], source, height, level < ROUGHNESSES.length ? ROUGHNESSES[level] ** 2 : -1, LEAST[level]) : halved[0];
        const data = new Uint16Array(8 * height * height);
        for (let k = 0; k < 2 * height * height; k++) for (let channel = 0; channel < 3; channel++) data[4 * k + channel] = toHalf(values[3 * k + channel]);
        return { width: 2 * height, height, data };
    });
}

/** Twice as wide as `height`, by means over solid angles. */
function resampled({ width, height: rows, data }, height) {
    const down = overlaps(rows, height, (row) => Math.cos(Math.PI * row / rows) - Math.cos(Math.PI * (row + 1) / rows));
    const across = overlaps(width, 2 * height, () => 1);
    const narrow = new Float64Array(3 * rows * 2 * height), out = new Float64Array(6 * height * height);
    for (let y = 0; y < rows; y++) across.forEach((parts, x) => {
        for (const [from, weight] of parts) for (let k = 0; k < 3; k++) narrow[3 * (y * 2 * height + x) + k] += weight * data[3 * (y * width + from) + k];
    });
    down.forEach((parts, y) => {
        for (const [from, weight] of parts) for (let k = 0; k < 6 * height; k++) out[y * 6 * height + k] += weight * narrow[from * 6 * height + k];
    });
    return out;
}

/** For each of `count` new cells the old ones that it overlaps, with weights that add up to 1. */
function overlaps(old, count, weigh) {
    return Array.from({ length: count }, (_, cell) => {
        const low = cell * old / count, high = (cell + 1) * old / count, parts = [];
        for (let from = Math.floor(low); from < Math.min(old, Math.ceil(high)); from++) {
            const share = Math.min(high, from + 1) - Math.max(low, from);
            if (share > 1e-9) parts.push([from, share * weigh(from)]);
        }
        const sum = parts.reduce((total, [, weight]) => total + weight, 0);
        return parts.map(([from, weight]) => [from, weight / sum]);
    });
}

function half(values, height) {
    return resampled({ width: 2 * height, height, data: values }, height / 2);
}

/** What a rough mirror that looks along its normal takes from a direction; the cosine for a negative `alpha`. */
function lobe(cosine, alpha) {
    if (cosine <= 0) return 0;
    if (alpha < 0) return cosine;
    const a2 = alpha * alpha, x = 0.5 * (1 + cosine) * (a2 - 1) + 1;
    return a2 / (Math.PI * x * x) * cosine;
}

function blurred(values, source, height, alpha, least) {
    const sines = Float64Array.from({ length: source }, (_, j) => Math.sin(Math.PI * (j + 0.5) / source));
    const cosines = Float64Array.from({ length: source }, (_, j) => Math.cos(Math.PI * (j + 0.5) / source));
    const bound = least * lobe(1, alpha), out = new Float64Array(6 * height * height);
    let reach = alpha < 0 ? Math.PI / 2 : 0;
    while (alpha >= 0 && reach < Math.PI / 2 && lobe(Math.cos(reach), alpha) > bound) reach += 0.002;
    for (let row = 0; row < height; row++) {
        const polar = Math.PI * (row + 0.5) / height, sine = Math.sin(polar), cosine = Math.cos(polar);
        const top = Math.max(0, Math.floor((polar - reach) / Math.PI * source - 1));
        const bottom = Math.min(source, Math.floor((polar + reach) / Math.PI * source + 2));
        for (let column = 0; column < 2 * height; column++) {
            const longitude = (column + 0.5) / height, place = 3 * (row * 2 * height + column);
            let total = 0;
            for (let i = 0; i < 2 * source; i++) {
                const turn = Math.cos(Math.PI * (longitude - (i + 0.5) / source));
                for (let j = top; j < bottom; j++) {
                    const weight = lobe(sine * sines[j] * turn + cosine * cosines[j], alpha);
                    if (weight <= bound) continue;
                    const share = weight * sines[j], from = 3 * (j * 2 * source + i);
                    total += share;
                    for (let k = 0; k < 3; k++) out[place + k] += share * values[from + k];
                }
            }
            for (let k = 0; k < 3; k++) out[place + k] /= total;
        }
    }
    return out;
}

/** Scale and bias of F0, {width, height, data}: rows are roughness 0 to 1, columns the cosine to the viewer. */
export function splitSumTable() {
    const { rows, columns, samples } = TABLE, data = new Uint16Array(4 * rows * columns);
    for (let row = 0; row < rows; row++) for (let column = 0; column < columns; column++) {
        const alpha = Math.max((row / (rows - 1)) ** 2, 1e-4), z = Math.max(column / (columns - 1), 1e-3), x = Math.sqrt(1 - z * z);
        const length = Math.hypot(alpha * x, z);
        let scale = 0, bias = 0;
        for (let k = 0; k < samples; k++) {
            const height = (1 - (k + 0.5) / samples) * (1 + z / length) - z / length, angle = 2 * Math.PI * radical(k);
            const radius = Math.sqrt(Math.max(1 - height * height, 0));
            const h = [alpha * (radius * Math.cos(angle) + alpha * x / length), alpha * radius * Math.sin(angle), Math.max(height + z / length, 1e-9)];
            const norm = Math.hypot(...h), cosine = (x * h[0] + z * h[2]) / norm, out = 2 * cosine * h[2] / norm - z;
            if (out <= 0) continue;
            const masking = 2 / (1 + Math.sqrt(1 + alpha * alpha * Math.max(1 - out * out, 0) / Math.max(out * out, 1e-12)));
            const weight = Math.min(Math.max(1 - cosine, 0), 1) ** 5;
            scale += (1 - weight) * masking;
            bias += weight * masking;
        }
        const place = 4 * (row * columns + column);
        data[place] = toHalf(scale / samples);
        data[place + 1] = toHalf(bias / samples);
    }
    return { width: columns, height: rows, data };
}

function radical(bits) {
    let value = 0;
    for (let share = 0.5; bits > 0; bits >>= 1, share /= 2) value += share * (bits & 1);
    return value;
}

/** Right, up and forward of a map in the world, as engine/shading/environment_frame.py has them. */
export function frameOfMap(up, degrees) {
    const [u, along] = [unit(up), (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0)];
    const first = Math.abs(u[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1];
    const ahead = unit(first.map((value, k) => value - along(first, u) * u[k]));
    const left = cross(u, ahead), angle = degrees * Math.PI / 180;
    const forward = ahead.map((value, k) => Math.cos(angle) * value + Math.sin(angle) * left[k]);
    return [cross(forward, u), u, forward];
}

const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
