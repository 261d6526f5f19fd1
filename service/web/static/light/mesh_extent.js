// The longest side of a mesh file, as far as its text or header says it; 1 where that cannot be told.

export async function meshExtent(file) {
    const name = file.name.toLowerCase();
    try {
        if (name.endsWith(".glb")) return glb(await file.arrayBuffer());
        if (name.endsWith(".obj")) return lines(await file.text(), /^v\s+(\S+)\s+(\S+)\s+(\S+)/gm);
        if (name.endsWith(".ply")) return ply(await file.arrayBuffer());
    } catch { /* whoever renders it says what is wrong */ }
    return 1;
}

/** glTF says the bounds of all positions; turns and scales of its nodes are left out. */
function glb(buffer) {
    const view = new DataView(buffer);
    const content = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, view.getUint32(12, true))));
    const box = new Box();
    for (const mesh of content.meshes ?? []) {
        for (const { attributes } of mesh.primitives) {
            const { min, max } = content.accessors[attributes.POSITION];
            box.add(min);
            box.add(max);
        }
    }
    return box.side();
}

function lines(text, pattern) {
    const box = new Box();
    for (const [, x, y, z] of text.matchAll(pattern)) box.add([x, y, z].map(Number));
    return box.side();
}

const SIZES = { char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2, int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8 };

function ply(buffer) {
    const start = new TextDecoder("latin1").decode(new Uint8Array(buffer, 0, Math.min(buffer.byteLength, 1 << 16)));
    const [header] = /^[\s\S]*?end_header\r?\n/.exec(start);
    const count = Number(/element vertex (\d+)/.exec(header)[1]);
    const properties = [...header.slice(header.indexOf("element vertex")).split(/element (?!vertex)/)[0].matchAll(/property (\w+) (\w+)/g)];
    const names = properties.map(([, , name]) => name);
    const box = new Box();
    if (/format ascii/.test(header)) {
        const rows = new TextDecoder().decode(buffer).slice(header.length).split("\n");
        for (const row of rows.slice(0, count)) box.add(["x", "y", "z"].map((axis) => Number(row.trim().split(/\s+/)[names.indexOf(axis)])));
        return box.side();
    }
    const view = new DataView(buffer, header.length), little = /little/.test(header);
    const places = properties.map((_, k) => properties.slice(0, k).reduce((sum, [, type]) => sum + SIZES[type], 0));
    const stride = properties.reduce((sum, [, type]) => sum + SIZES[type], 0);
    for (let row = 0; row < count; row++) {
        box.add(["x", "y", "z"].map((axis) => {
            const k = names.indexOf(axis), at = row * stride + places[k];
            return SIZES[properties[k][1]] === 8 ? view.getFloat64(at, little) : view.getFloat32(at, little);
        }));
    }
    return box.side();
}

class Box {
    low = [Infinity, Infinity, Infinity];
    high = [-Infinity, -Infinity, -Infinity];

    add(point) {
        for (let axis = 0; axis < 3; axis++) {
            this.low[axis] = Math.min(this.low[axis], point[axis]);
            this.high[axis] = Math.max(this.high[axis], point[axis]);
        }
    }

    side() {
        const side = Math.max(...this.high.map((value, axis) => value - this.low[axis]));
        return Number.isFinite(side) && side > 0 ? side : 1;
    }
}
