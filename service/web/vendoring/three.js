// What the viewer uses of three.js.
export {
    AddEquation, Color, CustomBlending, DataTexture, DynamicDrawUsage, Float32BufferAttribute, FloatType, GLSL3,
    HalfFloatType, InstancedBufferAttribute, InstancedBufferGeometry, LinearFilter, LinearSRGBColorSpace, Mesh,
    NearestFilter, NoBlending, OneFactor, OneMinusSrcAlphaFactor, OrthographicCamera, PerspectiveCamera,
    RawShaderMaterial, RGBAFormat, Scene, UnsignedByteType, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
