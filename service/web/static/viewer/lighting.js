// Draws a scene with materials in the light of a map, pixel by pixel; nothing is traced, so nothing is mirrored
// but the light itself.

import {
    AddEquation, CustomBlending, DataTexture, GLSL3, HalfFloatType, LinearFilter, LinearSRGBColorSpace, Mesh, NearestFilter,
    NoBlending, OneFactor, OneMinusSrcAlphaFactor, RawShaderMaterial, RGBAFormat, Scene, Vector2, Vector3, WebGLRenderTarget,
} from "../vendor/three.js";
import { frameOfMap, levelsOf, splitSumTable } from "./environment.js";
import { LIT_FRAGMENT, MATERIAL_FRAGMENT, MATERIAL_VERTEX } from "./lit_shaders.js";
import { PRESENT_VERTEX } from "./shaders.js";

const REPEAT = 1000; // three.js's RepeatWrapping
const LEVELS = ["level0", "level1", "level2", "level3", "level4", "level5", "irradiance"];

/** The two passes: materials and normals blended, then shaded. */
export class Lighting {
    /**
     * @param geometry octagons
     * @param uniforms `geometryTexture`, `geometryColumns`, `materialTexture`, `materialColumns` and `q`
     * @param flat a scene's maker: takes the material that fills the screen
     */
    constructor(geometry, uniforms, flat) {
        this.target = new WebGLRenderTarget(1, 1, {
            count: 3, type: HalfFloatType, depthBuffer: false, minFilter: NearestFilter, magFilter: LinearFilter, colorSpace: LinearSRGBColorSpace,
        });
        const mesh = new Mesh(geometry, new RawShaderMaterial({
            glslVersion: GLSL3, vertexShader: MATERIAL_VERTEX, fragmentShader: MATERIAL_FRAGMENT, uniforms,
            depthTest: false, depthWrite: false, side: 2, transparent: true,
            blending: CustomBlending, blendEquation: AddEquation, blendSrc: OneFactor, blendDst: OneMinusSrcAlphaFactor,
        }));
        mesh.frustumCulled = false;
        this.octagons = new Scene().add(mesh);
        const [color, facing, rest] = this.target.textures;
        this.uniforms = Object.fromEntries(Object.entries({
            color, facing, rest, table: textureOf(splitSumTable()), sizePx: new Vector2(), background: null, cameraWorld: null,
            projectionInverse: null, right: new Vector3(), up: new Vector3(), forward: new Vector3(),
            ...Object.fromEntries(LEVELS.map((name) => [name, null])),
        }).map(([name, value]) => [name, { value }]));
        this.scene = flat(new RawShaderMaterial({
            glslVersion: GLSL3, vertexShader: PRESENT_VERTEX, fragmentShader: LIT_FRAGMENT, uniforms: this.uniforms,
            depthTest: false, depthWrite: false, blending: NoBlending,
        }));
    }

    /** Takes over the map of another one, and how that lies. */
    takeOver(other) {
        for (const name of [...LEVELS, "right", "up", "forward"]) this.uniforms[name].value = other.uniforms[name].value;
    }

    /** Frees what is its own; the map may have been taken over. */
    dispose() {
        const { materialTexture } = this.octagons.children[0].material.uniforms;
        const own = [this.target, this.uniforms.table.value, materialTexture.value, this.octagons.children[0].material];
        for (const owned of own) owned.dispose();
    }

    /** Takes a map as of environment.js. */
    setMap(map) {
        levelsOf(map).forEach((level, k) => {
            this.uniforms[LEVELS[k]].value?.dispose();
            this.uniforms[LEVELS[k]].value = textureOf(level, REPEAT);
        });
    }

    /** How the map lies: its up in the world, and degrees about it. */
    turn(up, degrees) {
        frameOfMap(up, degrees).forEach((axis, k) => this.uniforms[["right", "up", "forward"][k]].value.fromArray(axis));
    }
}

function textureOf({ width, height, data }, wrap) {
    const texture = new DataTexture(data, width, height, RGBAFormat, HalfFloatType);
    texture.minFilter = texture.magFilter = LinearFilter;
    if (wrap) texture.wrapS = wrap;
    texture.needsUpdate = true;
    return texture;
}
