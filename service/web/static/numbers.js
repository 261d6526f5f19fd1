// Numbers as the pages write them: narrow spaces between thousands, as service/web/formatting.py does.

export function thousands(value, digits = 0) {
    return value.toLocaleString("en", { maximumFractionDigits: digits }).replaceAll(",", "\u202f");
}
