// Numbers and times as service/web/formatting.py writes them, narrow spaces between thousands.

export function thousands(value, digits = 0) {
    return value.toLocaleString("en", { maximumFractionDigits: digits }).replaceAll(",", "\u202f");
}

/** A length of time by its two largest units. */
export function duration(seconds) {
    const total = Math.max(0, Math.round(seconds)), minutes = Math.floor(total / 60), hours = Math.floor(minutes / 60);
    if (total < 60) return `${total} s`;
    if (minutes < 60) return two(minutes, "min", minutes < 10 ? total % 60 : 0, "s");
    return hours < 24 ? two(hours, "h", minutes % 60, "min") : two(Math.floor(hours / 24), "d", hours % 24, "h");
}

const two = (large, unit, small, smallUnit) => (small ? `${large} ${unit} ${small} ${smallUnit}` : `${large} ${unit}`);
