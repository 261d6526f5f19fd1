// Octagons in their true order at every pixel, by averaging frames that need no order.
//
// Sorting whole octagons is wrong where they cross. Here each frame draws a pixel of an octagon solid, with a
// chance of alpha, or not at all; the depth buffer keeps the nearest. The mean of many frames is the blend that a
// ray tracer computes. It is taken of display values, as octasplat composites them.
import {
  DoubleSide, FloatType, GLSL3, Mesh, NearestFilter, NoBlending, OrthographicCamera, PlaneGeometry,
  RawShaderMaterial, Scene, Vector2, WebGLRenderTarget,
} from "three";

const OCTAGON_VERTEX = `
uniform mat4 modelViewMatrix, projectionMatrix;
in vec3 position; in vec4 color; in vec2 uv;
out vec4 vertexColor; out vec2 vertexUv; flat out uint octagon;
void main() {
  vertexColor = color; vertexUv = uv; octagon = uint(gl_VertexID) / 8u;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;
const OCTAGON_FRAGMENT = `
precision highp float; precision highp int;
uniform sampler2D fallOff; uniform uint frame;
in vec4 vertexColor; in vec2 vertexUv; flat in uint octagon;
out vec4 color;
uvec4 pcg(uvec4 v) { // Jarzynski and Olano, Hash Functions for GPU Rendering, 2020
  v = v * 1664525u + 1013904223u;
  v.x += v.y * v.w; v.y += v.z * v.x; v.z += v.x * v.y; v.w += v.y * v.z;
  v ^= v >> 16u;
  v.x += v.y * v.w; v.y += v.z * v.x; v.z += v.x * v.y; v.w += v.y * v.z;
  return v;
}
void main() {
  float chance = float(pcg(uvec4(uvec2(gl_FragCoord.xy), octagon, frame)).x >> 8u) / 16777216.0;
  if (chance >= vertexColor.a * texture(fallOff, vertexUv).a) discard;
  vec3 linear = vertexColor.rgb;
  vec3 display = mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
  color = vec4(display, 1.0);
}`;
const FULL_VERTEX = `
in vec3 position;
void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }`;
const MEAN_FRAGMENT = `
precision highp float;
uniform sampler2D before, latest; uniform float weight;
out vec4 color;
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  color = mix(texelFetch(before, pixel, 0), texelFetch(latest, pixel, 0), weight);
}`;

export class Refiner {
  // `octagons` is the mesh of mergeOctagons.
  constructor(renderer, octagons) {
    this.renderer = renderer;
    this.octagons = new Scene();
    this.drawing = material(OCTAGON_VERTEX, OCTAGON_FRAGMENT, { fallOff: octagons.material.map, frame: 0 });
    this.drawing.side = DoubleSide;
    const copy = new Mesh(octagons.geometry, this.drawing);
    copy.matrixAutoUpdate = false;
    copy.matrix.copy(octagons.matrix);
    copy.frustumCulled = false;
    this.octagons.add(copy);
    const size = renderer.getDrawingBufferSize(new Vector2());
    const target = (type, depthBuffer) =>
      new WebGLRenderTarget(size.x, size.y, { type, depthBuffer, minFilter: NearestFilter, magFilter: NearestFilter });
    this.sample = target(undefined, true);
    this.means = [target(FloatType, false), target(FloatType, false)];
    this.averaging = material(FULL_VERTEX, MEAN_FRAGMENT, { before: null, latest: this.sample.texture, weight: 1 });
    this.averaging.depthTest = false;
    this.full = new Scene();
    this.full.add(new Mesh(new PlaneGeometry(2, 2), this.averaging));
    this.full.children[0].frustumCulled = false;
    this.flat = new OrthographicCamera();
    this.frames = 0;
  }

  // Begin again; call it when the camera has moved.
  reset() {
    this.frames = 0;
  }

  // Add one frame to the mean.
  add(camera) {
    const { renderer, averaging, means } = this;
    this.drawing.uniforms.frame.value = this.frames++;
    renderer.setRenderTarget(this.sample);
    renderer.setClearColor(0x000000, 1);
    renderer.clear();
    renderer.render(this.octagons, camera);
    averaging.uniforms.before.value = means[0].texture;
    averaging.uniforms.latest.value = this.sample.texture;
    averaging.uniforms.weight.value = 1 / this.frames;
    renderer.setRenderTarget(means[1]);
    renderer.render(this.full, this.flat);
    renderer.setRenderTarget(null);
    means.reverse();
  }

  // Draw the mean on the canvas.
  show() {
    const { uniforms } = this.averaging;
    uniforms.before.value = uniforms.latest.value = this.means[0].texture;
    this.renderer.setRenderTarget(null);
    this.renderer.render(this.full, this.flat);
  }

  dispose() {
    for (const one of [this.sample, ...this.means, this.drawing, this.averaging]) one.dispose();
  }
}

function material(vertexShader, fragmentShader, values) {
  const uniforms = Object.fromEntries(Object.entries(values).map(([name, value]) => [name, { value }]));
  return new RawShaderMaterial({ glslVersion: GLSL3, vertexShader, fragmentShader, uniforms, blending: NoBlending });
}
