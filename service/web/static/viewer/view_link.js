// A view in the part of an address behind #: where the camera is, what it looks at, its angle, and the aspect of what
// is to be seen wholly, as a narrow window takes a wider angle for it.

const DIGITS = 6;

/** The part of the address for a camera. */
export function linkOf(position, target, fovY, aspect) {
    return `#view=${[...position, ...target, fovY, aspect].map((value) => Number(value.toPrecision(DIGITS))).join(",")}`;
}

/** {position, target, fovY, aspect} of such a part; null where it is none. Older ones have no aspect. */
export function viewOf(hash) {
    const numbers = /^#view=([-+.,\de]+)$/i.exec(hash)?.[1].split(",").map(Number) ?? [];
    if (![7, 8].includes(numbers.length) || !numbers.every(Number.isFinite)) return null;
    const [fovY, aspect] = numbers.slice(6);
    return { position: numbers.slice(0, 3), target: numbers.slice(3, 6), fovY: Math.min(150, Math.max(1, fovY)), aspect: aspect > 0 ? aspect : undefined };
}
