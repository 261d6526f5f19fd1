"""Renders a lit GLB by Cycles: render_lit.py -- FILE.glb LIGHT.hdr VIEW.json OUT.png SAMPLES.

The light lies as Blender lays an environment by itself. The picture has straight alpha.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

glb, light, view, out, samples = sys.argv[sys.argv.index("--") + 1 :]
seen = json.loads(Path(view).read_text(encoding="utf-8"))
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=glb)
scene = bpy.context.scene
world = bpy.data.worlds.new("light")
world.use_nodes = True
picture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
picture.image = bpy.data.images.load(light)
world.node_tree.links.new(picture.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"])
scene.world = world
width, height = seen["width"], seen["height"]
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.sensor_fit, camera.data.sensor_width = "HORIZONTAL", 36.0
camera.data.lens = 36.0 * seen["fx"] / width
camera.data.shift_x = (width / 2 - seen["cx"]) / width
camera.data.shift_y = (seen["cy"] - height / 2) / width
camera.data.clip_start, camera.data.clip_end = 0.01, 1000.0
# glTF's y is Blender's z.
camera.matrix_world = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1))) @ Matrix(
    seen["gltf_from_camera"]
)
scene.collection.objects.link(camera)
scene.camera = camera
scene.render.engine = "CYCLES"
scene.cycles.device = "CPU"
scene.cycles.samples = int(samples)
scene.cycles.use_denoising = False
scene.cycles.use_adaptive_sampling = False
scene.cycles.blur_glossy = 0.0
scene.cycles.transparent_max_bounces = 128
scene.cycles.sample_clamp_indirect = 0.0
scene.render.threads_mode, scene.render.threads = "FIXED", 2
scene.render.film_transparent = True
scene.view_settings.view_transform = "Standard"
scene.render.resolution_x, scene.render.resolution_y = width, height
scene.render.resolution_percentage = 100
scene.render.image_settings.file_format = "PNG"
scene.render.image_settings.color_mode = "RGBA"
scene.render.image_settings.color_depth = "16"
scene.render.filepath = out
bpy.ops.render.render(write_still=True)
