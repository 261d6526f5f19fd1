"""New views of a scene: cameras, camera paths, images and videos."""
