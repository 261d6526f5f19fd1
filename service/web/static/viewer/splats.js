// Draws octagons on three.js, composited as display values, which is how they were trained.

import {
    AddEquation, Color, CustomBlending, DataTexture, DynamicDrawUsage, Float32BufferAttribute, FloatType, GLSL3,
    HalfFloatType, InstancedBufferAttribute, InstancedBufferGeometry, LinearFilter, LinearSRGBColorSpace, Mesh,
    NearestFilter, NoBlending, OneFactor, OneMinusSrcAlphaFactor, OrthographicCamera, RawShaderMaterial, RGBAFormat, Scene,
    UnsignedByteType, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "../vendor/three.js";
import { Lighting } from "./lighting.js";
import { FRAGMENT, PRESENT_FRAGMENT, PRESENT_VERTEX, VERTEX } from "./shaders.js";

export const CHI2_2_99 = 9.210340371976184;
const SIDES = 8;
const FAN = Array.from({ length: SIDES - 2 }, (_, k) => [0, k + 1, k + 2]).flat();

/** Draws one scene into a canvas. */
export class SplatRenderer {
    constructor(canvas) {
        this.renderer = new WebGLRenderer({ canvas, antialias: false, depth: false, stencil: false, alpha: false, powerPreference: "high-performance" });
        this.renderer.outputColorSpace = LinearSRGBColorSpace; // nothing is converted: the numbers are display values
        this.renderer.autoClear = false;
        const gl = this.renderer.getContext();
        // Sums of many layers in 8 bits would lose them one by one; colours above 1 would be cut too early.
        const precise = gl.getExtension("EXT_color_buffer_half_float") || gl.getExtension("EXT_color_buffer_float");
        this.target = new WebGLRenderTarget(1, 1, {
            type: precise ? HalfFloatType : UnsignedByteType, depthBuffer: false,
            minFilter: NearestFilter, magFilter: LinearFilter, colorSpace: LinearSRGBColorSpace,
        });
        this.scene = new Scene();
        this.mesh = null;
        this.lighting = null;
        this.isLit = false;
        this.background = new Color(0, 0, 0);
        this.present = presentation(this.target, this.background);
        this.precise = Boolean(precise);
        this.flat = new OrthographicCamera();
        this.scale = 1;
        this.buffer = new Vector2();
    }

    /** Takes over a scene as of ply.js. */
    setScene(scene, q = CHI2_2_99) {
        const limit = this.renderer.capabilities.maxTextureSize;
        const geometry = packed(scene.geometry, scene.count, 3, limit, FloatType, Float32Array);
        const harmonics = packed(scene.harmonics, scene.count, scene.shCount, limit, HalfFloatType, Uint16Array);
        this.mesh?.geometry.dispose();
        this.scene.clear();
        this.mesh = new Mesh(octagons(scene.count), new RawShaderMaterial({
            glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT,
            uniforms: {
                geometryTexture: { value: geometry.texture }, geometryColumns: { value: geometry.columns },
                harmonicsTexture: { value: harmonics.texture }, harmonicsColumns: { value: harmonics.columns },
                shCount: { value: scene.shCount }, q: { value: q },
            },
            depthTest: false, depthWrite: false, side: 2, transparent: true,
            blending: CustomBlending, blendEquation: AddEquation, blendSrc: OneFactor, blendDst: OneMinusSrcAlphaFactor,
        }));
        this.mesh.frustumCulled = false;
        this.scene.add(this.mesh);
        if (!scene.materials || !this.precise) return;
        const materials = packed(scene.materials, scene.count, 2, limit, HalfFloatType, Uint16Array);
        const { geometryTexture, geometryColumns, q: radius } = this.mesh.material.uniforms;
        const uniforms = { geometryTexture, geometryColumns, q: radius, materialTexture: { value: materials.texture }, materialColumns: { value: materials.columns } };
        this.lighting = new Lighting(this.mesh.geometry, uniforms, fullScreen);
        this.lighting.uniforms.background.value = this.background;
    }

    /** Shows materials in the light of a map as of environment.js; null goes back to the harmonics. */
    setLight(map) {
        if (map) this.lighting.setMap(map);
        this.isLit = Boolean(map);
    }

    /** Draws the first `count` Gaussians of `order`, in that order. */
    setOrder(order, count) {
        const attribute = this.mesh.geometry.getAttribute("number");
        attribute.array.set(order.subarray(0, count));
        attribute.clearUpdateRanges();
        attribute.addUpdateRange(0, count);
        attribute.needsUpdate = true;
        this.mesh.geometry.instanceCount = count;
    }

    /** Size on the page, and pixels of the screen for each of the page's. */
    setSize(width, height, pixelRatio) {
        this.renderer.setPixelRatio(pixelRatio);
        this.renderer.setSize(width, height, false);
    }

    setBackground(red, green, blue) {
        this.background.setRGB(red, green, blue, LinearSRGBColorSpace);
    }

    render(camera) {
        this.renderer.getDrawingBufferSize(this.buffer);
        const width = Math.max(1, Math.round(this.buffer.x * this.scale)), height = Math.max(1, Math.round(this.buffer.y * this.scale));
        const target = this.isLit ? this.lighting.target : this.target;
        if (target.width !== width || target.height !== height) target.setSize(width, height);
        this.renderer.setRenderTarget(target);
        this.renderer.setClearColor(0x000000, 0);
        this.renderer.clear(true, false, false);
        if (this.mesh) this.renderer.render(this.isLit ? this.lighting.octagons : this.scene, camera);
        this.renderer.setRenderTarget(null);
        const { uniforms } = this.isLit ? this.lighting : this.present.material;
        uniforms.sizePx.value.copy(this.buffer);
        if (this.isLit) [uniforms.cameraWorld.value, uniforms.projectionInverse.value] = [camera.matrixWorld, camera.projectionMatrixInverse];
        this.renderer.render(this.isLit ? this.lighting.scene : this.present.scene, this.flat);
    }
}

/** Back-to-front order that is made beside the page; `onOrder(order, count)` hears of it. */
export class Sorting {
    constructor(worker, count, q, onOrder) {
        this.worker = worker;
        this.reach = Math.sqrt(q);
        this.spare = new Uint32Array(count);
        this.wanted = null;
        this.position = new Vector3(Infinity, 0, 0);
        this.forward = new Vector3();
        this.now = new Vector3();
        worker.onmessage = ({ data }) => {
            if (!data.order) return;
            onOrder(data.order, data.count);
            this.spare = data.order;
            if (this.wanted) this.send();
        };
    }

    /** Asks for the order as seen by a camera, if it moved. */
    see(camera, distance) {
        camera.getWorldDirection(this.now);
        const moved = this.position.distanceTo(camera.position) > 1e-3 * distance || this.forward.dot(this.now) < 0.99999;
        if (!moved) return;
        this.position.copy(camera.position);
        this.forward.copy(this.now);
        this.wanted = { position: camera.position.toArray(), forward: this.now.toArray(), reach: this.reach };
        if (this.spare) this.send();
    }

    send() {
        this.worker.postMessage({ ...this.wanted, order: this.spare }, [this.spare.buffer]);
        this.spare = this.wanted = null;
    }
}

function octagons(count) {
    const geometry = new InstancedBufferGeometry();
    const corners = Array.from({ length: SIDES }, (_, k) => [Math.cos((2 * Math.PI * k) / SIDES), Math.sin((2 * Math.PI * k) / SIDES), 0]);
    geometry.setAttribute("position", new Float32BufferAttribute(corners.flat(), 3));
    geometry.setIndex(FAN);
    const numbers = new InstancedBufferAttribute(new Uint32Array(count), 1);
    numbers.setUsage(DynamicDrawUsage);
    geometry.setAttribute("number", numbers);
    geometry.instanceCount = 0;
    return geometry;
}

/** A texture with `texels` texels a Gaussian and as many Gaussians in a row as fit. */
function packed(values, count, texels, limit, type, ArrayType) {
    const columns = Math.max(1, Math.min(Math.floor(limit / texels), Math.ceil(Math.sqrt(count / texels))));
    const rows = Math.max(1, Math.ceil(count / columns));
    if (rows > limit) throw new Error(`${count} Gaussians are too many for this device.`);
    const padded = new ArrayType(columns * rows * texels * 4);
    padded.set(values);
    const texture = new DataTexture(padded, columns * texels, rows, RGBAFormat, type);
    texture.needsUpdate = true;
    return { texture, columns };
}

/** A scene of one triangle that fills the screen. */
function fullScreen(material) {
    const scene = new Scene();
    const geometry = new InstancedBufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
    geometry.instanceCount = 1;
    const mesh = new Mesh(geometry, material);
    mesh.frustumCulled = false;
    scene.add(mesh);
    return scene;
}

function presentation(target, background) {
    const material = new RawShaderMaterial({
        glslVersion: GLSL3, vertexShader: PRESENT_VERTEX, fragmentShader: PRESENT_FRAGMENT,
        uniforms: { image: { value: target.texture }, sizePx: { value: new Vector2() }, background: { value: background } },
        depthTest: false, depthWrite: false, blending: NoBlending,
    });
    return { scene: fullScreen(material), material };
}
