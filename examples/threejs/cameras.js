// Cameras of octasplat (COLMAP: x right, y down, z forward) for three.js (y up, looking along -z).
import { Matrix4, PerspectiveCamera } from "three";

const TURN = new Matrix4().makeScale(1, -1, -1);

// One frame, or one key, of a camera path, the JSON file that `octasplat render --path` takes.
export function cameraOfFrame(path, number, near = 0.01, far = 1000) {
  const frame = (path.frames ?? path.keys)[number];
  if (!frame) throw new Error(`the path has no camera ${number}`);
  const { width, height } = path;
  const fy = frame.fy ?? height / 2 / Math.tan((frame.fov_y_degrees * Math.PI) / 360);
  const fx = frame.fx ?? fy;
  const left = (-(frame.cx ?? width / 2) * near) / fx;
  const top = ((frame.cy ?? height / 2) * near) / fy;
  const camera = new PerspectiveCamera();
  camera.projectionMatrix.makePerspective(
    left, left + (width * near) / fx, top, top - (height * near) / fy, near, far, camera.coordinateSystem,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.updateProjectionMatrix = () => {}; // the matrix above stays
  // A half turn about x on both sides: of the world (as the GLB's root node does) and of the camera.
  const pose = new Matrix4().set(...frame.camera_to_world.flat());
  TURN.clone().multiply(pose).multiply(TURN).decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  return camera;
}
