// Materials in the light of a map: octagons blend their materials and normals, then each pixel is shaded once.

import { FALL_OFF, OCTAGON } from "./shaders.js";

export const MATERIAL_VERTEX = /* glsl */ `${OCTAGON}
uniform sampler2D materialTexture;
uniform int materialColumns;

flat out vec4 first;           // base color and metallic
flat out vec2 second;          // roughness and the share of light from all around
flat out vec3 normal;

void main() {
    int i = int(number);
    vec3 world;
    if (!placeCorner(i, world)) return;
    normal = normalize(cross(geometryAt(i, 1).xyz, geometryAt(i, 2).xyz));
    if (dot(normal, geometryAt(i, 0).xyz - cameraPosition) > 0.0) normal = -normal;
    ivec2 at = ivec2((i % materialColumns) * 2, i / materialColumns);
    first = texelFetch(materialTexture, at, 0);
    second = texelFetch(materialTexture, at + ivec2(1, 0), 0).xy;
}
`;

export const MATERIAL_FRAGMENT = /* glsl */ `${FALL_OFF}
flat in vec4 first;
flat in vec2 second;
flat in vec3 normal;
layout(location = 0) out vec4 color;
layout(location = 1) out vec4 facing;
layout(location = 2) out vec4 rest;

void main() {
    float alpha = alphaHere();
    color = vec4(first.rgb * alpha, alpha);
    facing = vec4(normal * alpha, alpha);
    rest = vec4(vec3(first.a, second) * alpha, alpha);
}
`;

export const LIT_FRAGMENT = /* glsl */ `
precision highp float;
precision highp sampler2D;
uniform sampler2D color, facing, rest, table;
uniform sampler2D level0, level1, level2, level3, level4, level5, irradiance;
uniform vec2 sizePx;
uniform vec3 background;
uniform mat4 cameraWorld, projectionInverse;
uniform vec3 right, up, forward;   // of the map
out vec4 shown;

const float PI = 3.141592653589793;

vec2 placeOf(vec3 d) {
    return vec2(0.5 + atan(d.x, d.z) / (2.0 * PI), acos(clamp(d.y, -1.0, 1.0)) / PI);
}

vec3 lobe(vec2 at, float roughness) {
    if (roughness < 0.15) return mix(texture(level0, at), texture(level1, at), max(roughness - 0.05, 0.0) / 0.1).rgb;
    if (roughness < 0.3) return mix(texture(level1, at), texture(level2, at), (roughness - 0.15) / 0.15).rgb;
    if (roughness < 0.5) return mix(texture(level2, at), texture(level3, at), (roughness - 0.3) / 0.2).rgb;
    if (roughness < 0.75) return mix(texture(level3, at), texture(level4, at), (roughness - 0.5) / 0.25).rgb;
    return mix(texture(level4, at), texture(level5, at), (roughness - 0.75) / 0.25).rgb;
}

void main() {
    vec2 place = gl_FragCoord.xy / sizePx;
    vec4 c = texture(color, place);
    shown = vec4(background, 1.0);
    if (c.a < 1e-3) return;
    vec3 albedo = c.rgb / c.a, others = texture(rest, place).rgb / c.a;
    float metallic = others.x, roughness = others.y, ambient = others.z;
    vec4 far = projectionInverse * vec4(2.0 * place - 1.0, 1.0, 1.0);
    mat3 map = transpose(mat3(right, up, forward));
    vec3 d = map * normalize(mat3(cameraWorld) * far.xyz / far.w);
    vec3 n = map * normalize(texture(facing, place).rgb);
    float cosine = -dot(d, n);
    vec2 ab = texture(table, (vec2(clamp(cosine, 1e-3, 1.0), roughness) * vec2(63.0, 31.0) + 0.5) / vec2(64.0, 32.0)).rg;
    vec3 f0 = 0.04 * (1.0 - metallic) + metallic * albedo;
    vec3 light = ambient * (f0 * ab.x + ab.y) * lobe(placeOf(d + 2.0 * cosine * n), roughness)
        + (1.0 - metallic) * albedo * ambient * texture(irradiance, placeOf(n)).rgb;
    light = clamp(light, 0.0, 1.0);
    vec3 curved = mix(1.055 * pow(max(light, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * light, vec3(lessThanEqual(light, vec3(0.0031308))));
    shown = vec4(clamp(c.a * curved + (1.0 - c.a) * background, 0.0, 1.0), 1.0);
}
`;
