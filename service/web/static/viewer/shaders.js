// One octagon: its corners from the Gaussian's numbers, its fall-off in every pixel.

// Begins a vertex shader: what it is given, and the corner of its octagon.
export const OCTAGON = /* glsl */ `
precision highp float;
precision highp int;
precision highp sampler2D;

uniform mat4 viewMatrix;
uniform mat4 projectionMatrix;
uniform vec3 cameraPosition;
uniform sampler2D geometryTexture;
uniform int geometryColumns;   // Gaussians in a row
uniform float q;               // squared radius of an opaque octagon, in standard deviations

in vec3 position;              // corner on the unit circle
in uint number;                // of the Gaussian

out vec2 plane;                // place in the octagon, in standard deviations
flat out float opacity;

vec4 geometryAt(int i, int k) {
    return texelFetch(geometryTexture, ivec2((i % geometryColumns) * 3 + k, i / geometryColumns), 0);
}

// Sets plane, opacity and gl_Position; whether anything shows.
bool placeCorner(int i, out vec3 world) {
    vec4 first = geometryAt(i, 0);
    opacity = first.w;
    // The radius at which alpha falls to exp(-q/2), whatever the opacity.
    float radius = sqrt(max(0.0, q + 2.0 * log(max(opacity, 1e-20))));
    plane = radius * position.xy;
    world = first.xyz + plane.x * geometryAt(i, 1).xyz + plane.y * geometryAt(i, 2).xyz;
    gl_Position = radius == 0.0 ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * viewMatrix * vec4(world, 1.0);
    return radius > 0.0;
}
`;

// Begins a fragment shader of an octagon.
export const FALL_OFF = /* glsl */ `
precision highp float;

in vec2 plane;
flat in float opacity;

float alphaHere() {
    return min(opacity * exp(-0.5 * dot(plane, plane)), 0.999);
}
`;

export const VERTEX = /* glsl */ `${OCTAGON}
uniform sampler2D harmonicsTexture;
uniform int harmonicsColumns;
uniform int shCount;

out vec3 color;

vec3 sh(ivec2 at, int k) {
    return texelFetch(harmonicsTexture, at + ivec2(k, 0), 0).rgb;
}

vec3 shaded(int i, vec3 d) {
    ivec2 at = ivec2((i % harmonicsColumns) * shCount, i / harmonicsColumns);
    vec3 sum = 0.5 + 0.28209479177387814 * sh(at, 0);
    if (shCount < 4) return sum;
    sum += 0.4886025119029199 * (-d.y * sh(at, 1) + d.z * sh(at, 2) - d.x * sh(at, 3));
    if (shCount < 9) return sum;
    vec3 dd = d * d;
    sum += 1.0925484305920792 * (d.x * d.y * sh(at, 4) - d.y * d.z * sh(at, 5) - d.x * d.z * sh(at, 7))
        + 0.31539156525252005 * (2.0 * dd.z - dd.x - dd.y) * sh(at, 6)
        + 0.5462742152960396 * (dd.x - dd.y) * sh(at, 8);
    if (shCount < 16) return sum;
    sum += -0.5900435899266435 * d.y * (3.0 * dd.x - dd.y) * sh(at, 9)
        + 2.890611442640554 * d.x * d.y * d.z * sh(at, 10)
        - 0.4570457994644658 * d.y * (4.0 * dd.z - dd.x - dd.y) * sh(at, 11)
        + 0.3731763325901154 * d.z * (2.0 * dd.z - 3.0 * dd.x - 3.0 * dd.y) * sh(at, 12)
        - 0.4570457994644658 * d.x * (4.0 * dd.z - dd.x - dd.y) * sh(at, 13)
        + 1.445305721320277 * d.z * (dd.x - dd.y) * sh(at, 14)
        - 0.5900435899266435 * d.x * (dd.x - 3.0 * dd.y) * sh(at, 15);
    return sum;
}

void main() {
    int i = int(number);
    vec3 world;
    if (placeCorner(i, world)) color = shaded(i, normalize(world - cameraPosition));
}
`;

export const FRAGMENT = /* glsl */ `${FALL_OFF}
in vec3 color;
out vec4 premultiplied;

void main() {
    float alpha = alphaHere();
    premultiplied = vec4(max(color, 0.0) * alpha, alpha);
}
`;

export const PRESENT_VERTEX = /* glsl */ `
precision highp float;
in vec3 position;

void main() {
    gl_Position = vec4(position.xy, 0.0, 1.0);
}
`;

export const PRESENT_FRAGMENT = /* glsl */ `
precision highp float;
precision highp sampler2D;
uniform sampler2D image;
uniform vec2 sizePx;
uniform vec3 background;
out vec4 shown;

void main() {
    vec4 seen = texture(image, gl_FragCoord.xy / sizePx);
    shown = vec4(clamp(seen.rgb + (1.0 - seen.a) * background, 0.0, 1.0), 1.0);
}
`;
