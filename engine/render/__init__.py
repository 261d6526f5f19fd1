"""New views of a scene: cameras, the paths they follow, and the images and videos they leave."""
