// A stage file (TOML) from what the form says and what is known of the scene.

const SIZE_OF_RADIUS = 0.4; // what the cameras look at is about this share of their distance from it
const LAMP_DISTANCE = 2, LAMP_SIDE = 0.8; // in sizes of the scene
const LIFT = 0.01; // of a floor and what stands on it, so that the Gaussians below do not come through

/**
 * @param values of the form: numbers as numbers, files by their names
 * @param scene {up, target, radius, forward}: of the cameras, and where the chosen one looks
 * @param spot {view, x, y}: a photograph and a pixel of it
 * @param extent longest side of the mesh that was chosen
 */
export function stageText(values, scene, spot, extent) {
    const size = SIZE_OF_RADIUS * scene.radius;
    const on = `on = { view = ${quoted(spot.view)}, pixel = [${number(spot.x)}, ${number(spot.y)}] }`;
    const up = unit(scene.up);
    const lifted = values.floor ? `position = ${vector(scaled(up, LIFT * size))}` : null;
    const mode = values.scene === "learnt" ? `# no light: materials, in the light ${values.sky ? "below" : "that was learnt with them"}` : `light = ${quoted(values.scene)}`;
    const parts = [["version = 1", `up = ${vector(up)}`], ["[[gaussians]]", mode]];
    if (values.thing !== "none" && (values.thing !== "file" || values.mesh)) {
        const height = values.size / 100 * size;
        parts.push([
            "[[meshes]]",
            values.thing === "file" ? `file = ${quoted(values.mesh)}` : `shape = ${quoted(values.thing)}`,
            on,
            lifted,
            `rotation_degrees = ${vector(turned(up, values.turn))}`,
            `scale = ${number(values.thing === "file" ? height / (extent || 1) : height / 2)}`,
            values.thing === "sphere" ? "smooth_degrees = 180" : null,
            `material = ${material(values)}`,
        ]);
    }
    if (values.floor) {
        const half = values.floor_size / 200 * size;
        parts.push(["[[meshes]]", 'shape = "plane"', on, lifted, `scale = ${number(half)}`, 'material = { kind = "mirror", color_srgb = [0.9, 0.9, 0.9] }']);
    }
    if (values.light !== "none") parts.push(light(values, scene, up, size));
    if (values.sky) {
        parts.push(["[environment]", `file = ${quoted(values.sky)}`, `rotation_degrees = ${number(values.sky_turn)}`, `strength = ${number(values.sky_strength)}`, `visible = ${values.sky_visible}`]);
    }
    parts.push(["[integrator]", `samples = ${values.samples}`, "clamp = 20.0", `exposure = ${number(values.exposure)}`]);
    return parts.map((lines) => lines.filter((line) => line !== null).join("\n")).join("\n\n") + "\n";
}

function light(values, scene, up, size) {
    const towards = directionTo(values, scene.forward, up);
    const way = vector(scaled(towards, -1));
    if (values.light === "sun") return ["[[lights]]", 'kind = "directional"', `direction = ${way}`, `irradiance = ${number(values.brightness)}`];
    const distance = LAMP_DISTANCE * size, side = LAMP_SIDE * size;
    const place = scene.target.map((value, axis) => value + distance * towards[axis]);
    // As bright in the middle of the scene as the sun would be.
    const radiance = values.brightness * distance ** 2 / side ** 2;
    return ["[[lights]]", 'kind = "rectangle"', `position = ${vector(place)}`, `direction = ${way}`, `width = ${number(side)}`, `height = ${number(side)}`, `radiance = ${number(radiance)}`, "visible = false"];
}

/** Where the light comes from: 0 degrees around is from behind the camera, 90 from its right. */
function directionTo({ height, around }, forward, up) {
    const level = unit(forward.map((value, axis) => value - dot(forward, up) * up[axis]));
    const right = cross(level, up);
    const high = radians(height), turn = radians(around);
    return level.map((value, axis) => Math.cos(high) * (right[axis] * Math.sin(turn) - value * Math.cos(turn)) + Math.sin(high) * up[axis]);
}

function material({ material, color, roughness }) {
    const rgb = [1, 3, 5].map((at) => number(parseInt(color.slice(at, at + 2), 16) / 255)).join(", ");
    if (material === "glass") return `{ kind = "glass", ior = 1.5, tint_srgb = [${rgb}] }`;
    const rough = material === "metal" || material === "dielectric" ? `, roughness = ${number(roughness)}` : "";
    return `{ kind = ${quoted(material)}, color_srgb = [${rgb}]${rough} }`;
}

/** A turn about `up` as turns about x, then y, then z. */
function turned(up, degrees) {
    const angle = radians(degrees), c = Math.cos(angle), s = Math.sin(angle), [x, y, z] = up;
    const row0 = c + x * x * (1 - c), row1 = y * x * (1 - c) + z * s, row2 = z * x * (1 - c) - y * s;
    const r21 = z * y * (1 - c) + x * s, r22 = c + z * z * (1 - c);
    return [Math.atan2(r21, r22), Math.asin(Math.max(-1, Math.min(1, -row2))), Math.atan2(row1, row0)].map((each) => each * 180 / Math.PI);
}

const radians = (degrees) => degrees * Math.PI / 180;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, factor) => a.map((value) => value * factor);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const number = (value) => String(Number(Number(value).toPrecision(5)));
const vector = (values) => `[${values.map((value) => number(Math.abs(value) < 1e-9 ? 0 : value)).join(", ")}]`;
// What JSON quotes, TOML's basic strings take.
const quoted = (text) => JSON.stringify(text);
