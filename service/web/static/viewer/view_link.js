// A view in the part of an address behind #: where the camera is, what it looks at, and its angle.

const DIGITS = 6;

/** The part of the address for a camera. */
export function linkOf(position, target, fovY) {
    return `#view=${[...position, ...target, fovY].map((value) => Number(value.toPrecision(DIGITS))).join(",")}`;
}

/** {position, target, fovY} of such a part; null where it is none. */
export function viewOf(hash) {
    const numbers = /^#view=([-+.,\de]+)$/i.exec(hash)?.[1].split(",").map(Number) ?? [];
    if (numbers.length !== 7 || !numbers.every(Number.isFinite)) return null;
    return { position: numbers.slice(0, 3), target: numbers.slice(3, 6), fovY: Math.min(150, Math.max(1, numbers[6])) };
}
