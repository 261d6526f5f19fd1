// Draws a mesh of a glTF file in the light of a lamp at the camera.

import { AmbientLight, Box3, Color, DirectionalLight, GLTFLoader, Scene, TextureLoader, Vector3, WebGLRenderer } from "../vendor/three.js";

const AMBIENT = 1.2;
const LAMP = 2;

export class MeshRenderer {
    constructor(canvas) {
        this.renderer = new WebGLRenderer({ canvas, antialias: true });
        this.scene = new Scene();
        this.lamp = new DirectionalLight(0xffffff, LAMP);
        this.scene.add(new AmbientLight(0xffffff, AMBIENT), this.lamp, this.lamp.target);
    }

    /** Loads the file; `onBytes` hears (loaded, total). Returns {center, radius, triangles}. */
    async load(url, onBytes = () => {}) {
        const loader = new GLTFLoader();
        // Images by elements: the page's policy lets them be blobs, but lets nothing be fetched from one.
        loader.register((parser) => {
            parser.textureLoader = new TextureLoader(parser.options.manager);
            return { name: "octasplat_image_elements" };
        });
        const { scene } = await loader.loadAsync(url, ({ loaded, total }) => onBytes(loaded, total));
        this.scene.add(scene);
        const box = new Box3().setFromObject(scene);
        let triangles = 0;
        scene.traverse(({ geometry }) => { if (geometry) triangles += (geometry.index ?? geometry.attributes.position).count / 3; });
        if (!triangles) throw new Error("The file holds no mesh.");
        return { center: box.getCenter(new Vector3()), radius: box.getSize(new Vector3()).length() / 2 || 1, triangles };
    }

    setBackground(r, g, b) {
        this.scene.background = new Color(r, g, b);
    }

    setSize(width, height, ratio) {
        this.renderer.setPixelRatio(ratio);
        this.renderer.setSize(width, height, false);
    }

    /** Draws what the camera sees; the lamp goes with it, towards `target`. */
    render(camera, target) {
        this.lamp.position.copy(camera.position);
        this.lamp.target.position.copy(target);
        this.renderer.render(this.scene, camera);
    }
}
