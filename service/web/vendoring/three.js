// What the viewers of scenes and meshes use of three.js.
export {
    AddEquation, AmbientLight, Box3, Color, CustomBlending, DataTexture, DirectionalLight, DynamicDrawUsage, Float32BufferAttribute, FloatType, GLSL3,
    HalfFloatType, InstancedBufferAttribute, InstancedBufferGeometry, LinearFilter, LinearSRGBColorSpace, Mesh,
    NearestFilter, NoBlending, OneFactor, OneMinusSrcAlphaFactor, OrthographicCamera, PerspectiveCamera,
    RawShaderMaterial, RGBAFormat, Scene, TextureLoader, UnsignedByteType, Vector2, Vector3, WebGLRenderer, WebGLRenderTarget,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
