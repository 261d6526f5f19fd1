// A PLY of Gaussians (3DGS layout, binary little endian) to the arrays that are drawn.

import { toHalf } from "./half.js";

const SIZES = {
    char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2,
    int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
};
const SH_DC = ["f_dc_0", "f_dc_1", "f_dc_2"];
const MATERIAL = ["albedo_0", "albedo_1", "albedo_2", "metallic", "roughness"];
const MAX_HEADER_BYTES = 1 << 16;

/** The header at the start of `bytes`; null while it is not complete. */
export function readHeader(bytes) {
    const text = new TextDecoder("latin1").decode(bytes.subarray(0, MAX_HEADER_BYTES));
    if (text.length >= 4 && !text.startsWith("ply")) throw new Error("The file is no PLY.");
    const end = text.search(/end_header\r?\n/);
    if (end < 0) {
        if (bytes.length >= MAX_HEADER_BYTES) throw new Error("The PLY has no end of its header.");
        return null;
    }
    const bodyStart = text.indexOf("\n", end) + 1;
    const offsets = {};
    let count = 0, stride = 0, element = "";
    for (const line of text.slice(0, end).split(/\r?\n/)) {
        const words = line.trim().split(/\s+/);
        if (words[0] === "format" && words[1] !== "binary_little_endian") throw new Error(`The PLY is ${words[1]}, not binary.`);
        if (words[0] === "element") {
            element = words[1];
            if (element === "vertex") count = Number(words[2]);
        }
        if (words[0] !== "property" || element !== "vertex") continue;
        if (!(words[1] in SIZES)) throw new Error("The PLY is none of Gaussians.");
        offsets[words[2]] = { at: stride, type: words[1] };
        stride += SIZES[words[1]];
    }
    for (const name of ["x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_3", ...SH_DC]) {
        if (!(name in offsets)) throw new Error(`The PLY has no ${name}, so it is none of Gaussians.`);
    }
    return { count, stride, offsets, bodyStart };
}

/**
 * The Gaussians of a whole file.
 *
 * @returns {{count, shCount, geometry: Float32Array, harmonics: Uint16Array, bounds: Float32Array, materials: ?Uint16Array}}
 *   geometry has 12 numbers a Gaussian: mean x y z and opacity, first leg x y z and 0, second leg x y z and 0,
 *   world units. A leg is an in-plane axis times its standard deviation. harmonics has 4 half-precision
 *   numbers a coefficient: red, green, blue and 0. bounds has the length of the longer leg. materials, if there
 *   are any, has 8 half-precision numbers: linear base color, metallic, roughness, share of ambient light, 0, 0.
 */
export function readGaussians(bytes) {
    const header = readHeader(bytes);
    if (header === null || bytes.length < header.bodyStart + header.count * header.stride) throw new Error("The PLY is cut short.");
    const { count, stride, offsets, bodyStart } = header;
    const view = new DataView(bytes.buffer, bytes.byteOffset + bodyStart, count * stride);
    const reader = (name) => {
        const { at, type } = offsets[name];
        if (type === "float" || type === "float32") return (row) => view.getFloat32(row + at, true);
        if (type === "double" || type === "float64") return (row) => view.getFloat64(row + at, true);
        throw new Error(`${name} of the PLY is no floating-point number.`);
    };
    const readers = (names) => names.map(reader);
    const means = readers(["x", "y", "z"]), quat = readers(["rot_0", "rot_1", "rot_2", "rot_3"]), dc = readers(SH_DC);
    const opacity = reader("opacity");
    const scales = readers(["scale_0", "scale_1", "scale_2"].filter((name) => name in offsets));
    let rest = 0;
    while (`f_rest_${rest}` in offsets) rest += 1;
    const restCount = Math.floor(rest / 3);
    const degree = Math.min(3, Math.floor(Math.sqrt(1 + restCount)) - 1);
    const shCount = (degree + 1) ** 2;
    // The file holds all red coefficients, then all green, then all blue.
    const restReaders = [];
    for (let channel = 0; channel < 3; channel++) {
        restReaders.push(readers(Array.from({ length: shCount - 1 }, (_, k) => `f_rest_${channel * restCount + k}`)));
    }

    const ofMaterial = MATERIAL.every((name) => name in offsets) ? readers(MATERIAL) : null;
    const ambient = "ambient" in offsets ? reader("ambient") : () => 1;
    const materials = ofMaterial && new Uint16Array(count * 8);
    let knowsMaterials = ofMaterial !== null; // what came from a scene without has 0 in all channels

    const geometry = new Float32Array(count * 12);
    const harmonics = new Uint16Array(count * shCount * 4);
    const bounds = new Float32Array(count);
    const sigma = [0, 0, 0];
    for (let i = 0; i < count; i++) {
        const row = i * stride, g = i * 12;
        for (let axis = 0; axis < 3; axis++) geometry[g + axis] = means[axis](row);
        geometry[g + 3] = 1 / (1 + Math.exp(-opacity(row)));
        let [w, x, y, z] = quat.map((read) => read(row));
        const length = Math.hypot(w, x, y, z);
        w /= length; x /= length; y /= length; z /= length;
        const columns = [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ];
        // Two scales belong to the last two axes; of three, the smallest is the normal's.
        if (scales.length === 2) [sigma[0], sigma[1], sigma[2]] = [0, Math.exp(scales[0](row)), Math.exp(scales[1](row))];
        else for (let axis = 0; axis < 3; axis++) sigma[axis] = Math.exp(scales[axis](row));
        const normal = sigma[0] <= sigma[1] && sigma[0] <= sigma[2] ? 0 : sigma[1] <= sigma[2] ? 1 : 2;
        let at = g + 4;
        for (let axis = 0; axis < 3; axis++) {
            if (axis === normal) continue;
            for (let k = 0; k < 3; k++) geometry[at + k] = columns[axis][k] * sigma[axis];
            at += 4;
        }
        bounds[i] = Math.max(...sigma);
        let finite = true;
        for (let k = 0; k < 12; k++) finite &&= Number.isFinite(geometry[g + k]);
        if (!finite) {
            geometry.fill(0, g, g + 12);
            bounds[i] = 0;
        }
        ofMaterial?.forEach((read, k) => { materials[i * 8 + k] = toHalf(read(row)); });
        if (materials) {
            materials[i * 8 + 5] = toHalf(ambient(row));
            knowsMaterials &&= ofMaterial.some((read) => read(row) !== 0) || ("ambient" in offsets && ambient(row) !== 0);
        }
        for (let channel = 0; channel < 3; channel++) {
            const h = i * shCount * 4 + channel;
            harmonics[h] = toHalf(dc[channel](row));
            for (let k = 1; k < shCount; k++) harmonics[h + 4 * k] = toHalf(restReaders[channel][k - 1](row));
        }
    }
    return { count, shCount, geometry, harmonics, bounds, materials, knowsMaterials };
}
