// Octagons of octasplat's GLB in one three.js mesh that is kept sorted from far to near.
import { BufferAttribute, BufferGeometry, Mesh, Vector3 } from "three";

const SIDES = 8;
const FAN = [1, 2, 3, 4, 5, 6].flatMap((corner) => [0, corner, corner + 1]);
const BUCKETS = 1 << 16;

// Solid middles, which a file made --for-viewers draws first: the same octagons once more.
export const isCore = (node) => node.material.name === "octagon_cores";

// The chunks of a loaded GLB as one mesh, for only within one mesh can the octagons of all chunks be sorted.
export function mergeOctagons(gltf) {
  gltf.scene.updateMatrixWorld(true);
  const parts = [];
  gltf.scene.traverse((node) => node.isMesh && !isCore(node) && parts.push(node));
  if (!parts.length || parts.some((part) => part.geometry.attributes.position.count % SIDES)) {
    throw new Error("This GLB does not hold octagons of octasplat.");
  }
  const vertices = parts.reduce((sum, part) => sum + part.geometry.attributes.position.count, 0);
  const geometry = new BufferGeometry();
  for (const [name, width] of [["position", 3], ["color", 4], ["uv", 2]]) {
    const whole = new Float32Array(vertices * width);
    let start = 0;
    for (const { geometry: { attributes } } of parts) {
      whole.set(attributes[name].array, start);
      start += attributes[name].array.length;
    }
    geometry.setAttribute(name, new BufferAttribute(whole, width));
  }
  geometry.setIndex(new BufferAttribute(new Uint32Array((vertices / SIDES) * FAN.length), 1));
  geometry.computeBoundingSphere();
  const mesh = new Mesh(geometry, parts[0].material);
  mesh.userData.centres = centresOf(geometry.attributes.position.array);
  mesh.matrixAutoUpdate = false;
  mesh.matrix.copy(parts[0].matrixWorld);
  mesh.updateMatrixWorld(true);
  return mesh;
}

// Corners 0 and 4 lie opposite each other.
function centresOf(positions) {
  const result = new Float32Array(positions.length / SIDES);
  for (let k = 0; k < result.length; k++) {
    const first = 3 * SIDES * Math.floor(k / 3) + (k % 3);
    result[k] = 0.5 * (positions[first] + positions[first + 12]);
  }
  return result;
}

// Write the triangles from far to near; call it when the camera has moved.
export function sortOctagons(mesh, camera) {
  const { centres } = mesh.userData;
  const count = centres.length / 3;
  const eye = mesh.worldToLocal(camera.getWorldPosition(new Vector3()));
  const distances = (mesh.userData.distances ??= new Float32Array(count));
  let nearest = Infinity, farthest = 0;
  for (let k = 0; k < count; k++) {
    const distance = Math.hypot(centres[3 * k] - eye.x, centres[3 * k + 1] - eye.y, centres[3 * k + 2] - eye.z);
    distances[k] = distance;
    nearest = Math.min(nearest, distance);
    farthest = Math.max(farthest, distance);
  }
  // A counting sort on 65,536 steps of the distance's logarithm, so that near octagons get the finer steps.
  const low = Math.log(Math.max(nearest, 1e-6 * farthest, 1e-30));
  const scale = (BUCKETS - 1) / Math.max(Math.log(Math.max(farthest, 1e-30)) - low, 1e-9);
  const starts = new Uint32Array(BUCKETS + 1);
  const buckets = (mesh.userData.buckets ??= new Uint16Array(count));
  for (let k = 0; k < count; k++) {
    const step = (Math.log(Math.max(distances[k], 1e-30)) - low) * scale;
    buckets[k] = BUCKETS - 1 - Math.min(Math.max(step, 0), BUCKETS - 1);
    starts[buckets[k] + 1]++;
  }
  for (let bucket = 0; bucket < BUCKETS; bucket++) starts[bucket + 1] += starts[bucket];
  const index = mesh.geometry.index;
  for (let k = 0; k < count; k++) {
    const first = FAN.length * starts[buckets[k]]++;
    for (let j = 0; j < FAN.length; j++) index.array[first + j] = SIDES * k + FAN[j];
  }
  index.needsUpdate = true;
}
