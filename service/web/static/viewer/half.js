// 16-bit floating-point numbers, as textures take them.

const value32 = new Float32Array(1);
const bits32 = new Uint32Array(value32.buffer);

/** The bits of the nearest half-precision number; what is too large becomes the largest. */
export function toHalf(value) {
    value32[0] = value;
    const bits = bits32[0];
    const sign = (bits >>> 16) & 0x8000;
    const exponent = (bits >>> 23) & 0xff;
    const mantissa = bits & 0x7fffff;
    if (exponent < 103) return sign;
    if (exponent > 142) return sign | 0x7bff;
    if (exponent < 113) {
        const shift = 126 - exponent;
        return sign | (((mantissa | 0x800000) + (1 << (shift - 1))) >>> shift);
    }
    // Rounded up, the largest would be infinite.
    return sign | Math.min(0x7bff, ((exponent - 112) << 10) + ((mantissa + 0x1000) >>> 13));
}
