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
const UPLOAD_BYTES = 4 << 20;
const FAN = Array.from({ length: SIDES - 2 }, (_, k) => [0, k + 1, k + 2]).flat();

/** Draws one scene into a canvas. */
export class SplatRenderer {
    constructor(canvas) {
        this.renderer = new WebGLRenderer({ canvas, antialias: false, depth: false, stencil: false, alpha: false, powerPreference: "high-performance" });
        this.renderer.outputColorSpace = LinearSRGBColorSpace; // nothing is converted: the numbers are display values
        this.renderer.autoClear = false;
        const gl = this.renderer.getContext();
        // Sums of many layers in 8 bits would lose them one by one; colors above 1 would be cut too early.
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

    /** Takes over a scene as of ply.js, a few megabytes at a time. */
    async setScene(scene, q = CHI2_2_99) {
        const geometry = await this.upload(scene.geometry, scene.count, 3, FloatType);
        const harmonics = await this.upload(scene.harmonics, scene.count, scene.shCount, HalfFloatType);
        this.forget();
        this.order = new Uint32Array(scene.count);
        this.ordered = 0;
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
        const materials = await this.upload(scene.materials, scene.count, 2, HalfFloatType);
        const { geometryTexture, geometryColumns, q: radius } = this.mesh.material.uniforms;
        const uniforms = { geometryTexture, geometryColumns, q: radius, materialTexture: { value: materials.texture }, materialColumns: { value: materials.columns } };
        const before = this.lighting;
        this.lighting = new Lighting(this.mesh.geometry, uniforms, fullScreen);
        if (before) {
            this.lighting.takeOver(before);
            before.dispose();
        }
        this.lighting.uniforms.background.value = this.background;
    }

    /** Frees what belongs to the scene before. */
    forget() {
        this.scene.clear();
        if (!this.mesh) return;
        const { geometryTexture, harmonicsTexture } = this.mesh.material.uniforms;
        for (const owned of [this.mesh.geometry, this.mesh.material, geometryTexture.value, harmonicsTexture.value]) owned.dispose();
    }

    /** Shows materials in the light of a map as of environment.js; null goes back to the harmonics. */
    setLight(map) {
        if (map) this.lighting.setMap(map);
        this.isLit = Boolean(map);
    }

    /** A texture with `texels` texels a Gaussian and as many Gaussians in a row as fit. */
    async upload(values, count, texels, type) {
        const limit = this.renderer.capabilities.maxTextureSize;
        const columns = Math.max(1, Math.min(Math.floor(limit / texels), Math.ceil(Math.sqrt(count / texels))));
        const rows = Math.max(1, Math.ceil(count / columns)), width = columns * texels;
        if (rows > limit) throw new Error(`${count} Gaussians are too many for this device.`);
        const texture = new DataTexture(null, width, rows, RGBAFormat, type);
        texture.source.dataReady = false; // allocates it
        texture.needsUpdate = true;
        this.renderer.initTexture(texture);
        const step = Math.max(1, Math.floor(UPLOAD_BYTES / (width * 4 * values.BYTES_PER_ELEMENT)));
        for (let row = 0; row < rows; row += step) {
            const taken = Math.min(step, rows - row);
            let part = values.subarray(4 * width * row, 4 * width * (row + taken));
            if (part.length < 4 * width * taken) {
                const padded = new values.constructor(4 * width * taken);
                padded.set(part);
                part = padded;
            }
            this.renderer.copyTextureToTexture(new DataTexture(part, width, taken, RGBAFormat, type), texture, null, new Vector2(0, row));
            if (row + taken < rows) await this.finished();
        }
        return { texture, columns };
    }

    /** Resolves once everything asked for so far is drawn; the page goes on meanwhile. */
    async finished() {
        const gl = this.renderer.getContext();
        const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl.flush();
        do await new Promise((resolve) => setTimeout(resolve, 4));
        while (fence && !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED);
        gl.deleteSync(fence);
    }

    /** The first `count` Gaussians of `order` will be drawn, in that order. */
    setOrder(order, count) {
        this.order.set(order.subarray(0, count));
        this.ordered = count;
    }

    /** Size on the page, and pixels of the screen for each of the page's. */
    setSize(width, height, pixelRatio) {
        this.renderer.setPixelRatio(pixelRatio);
        this.renderer.setSize(width, height, false);
    }

    setBackground(red, green, blue) {
        this.background.setRGB(red, green, blue, LinearSRGBColorSpace);
    }

    /** Draws all of the order. */
    render(camera) {
        this.begin();
        this.add(camera, 0, this.ordered);
        this.show(camera);
    }

    /** Begins a picture. */
    begin() {
        this.renderer.getDrawingBufferSize(this.buffer);
        const width = Math.max(1, Math.round(this.buffer.x * this.scale)), height = Math.max(1, Math.round(this.buffer.y * this.scale));
        const target = this.drawn;
        if (target.width !== width || target.height !== height) target.setSize(width, height);
        this.renderer.setRenderTarget(target);
        this.renderer.setClearColor(0x000000, 0);
        this.renderer.clear(true, false, false);
    }

    /** Adds `count` Gaussians of the order to the picture, which nearer ones follow. */
    add(camera, first, count) {
        const attribute = this.mesh.geometry.getAttribute("number");
        attribute.array.set(this.order.subarray(first, first + count));
        attribute.clearUpdateRanges();
        attribute.addUpdateRange(0, count);
        attribute.needsUpdate = true;
        this.mesh.geometry.instanceCount = count;
        this.renderer.setRenderTarget(this.drawn);
        this.renderer.render(this.isLit ? this.lighting.octagons : this.scene, camera);
    }

    get drawn() {
        return this.isLit ? this.lighting.target : this.target;
    }

    /** Puts the picture onto the page. */
    show(camera) {
        this.renderer.setRenderTarget(null);
        const { uniforms } = this.isLit ? this.lighting : this.present.material;
        uniforms.sizePx.value.copy(this.buffer);
        if (this.isLit) [uniforms.cameraWorld.value, uniforms.projectionInverse.value] = [camera.matrixWorld, camera.projectionMatrixInverse];
        this.renderer.render(this.isLit ? this.lighting.scene : this.present.scene, this.flat);
    }
}

/** Back-to-front order that is made beside the page; `onOrder(order, count, limit)` hears of it. */
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
            this.spare = data.order;
            onOrder(data.order, data.count, data.limit);
            if (this.wanted) this.send();
        };
    }

    /** Asks for the order anew when a camera is next seen, as other Gaussians are to be drawn. */
    forget() {
        this.position.set(Infinity, 0, 0);
    }

    /** Asks for the order of the `limit` heaviest as seen by a camera, if it moved; whether it did. */
    see(camera, distance, limit = Infinity) {
        camera.getWorldDirection(this.now);
        const moved = this.position.distanceTo(camera.position) > 1e-3 * distance || this.forward.dot(this.now) < 0.99999;
        if (!moved && limit === this.limit) return false;
        this.limit = limit;
        this.position.copy(camera.position);
        this.forward.copy(this.now);
        this.wanted = { position: camera.position.toArray(), forward: this.now.toArray(), reach: this.reach, limit };
        if (this.spare) this.send();
        return true;
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
