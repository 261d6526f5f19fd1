"""Renders one frame of a .blend through the pixels' centres: render_blend.py -- BLEND OUT.png FRAME."""

import sys

import bpy

blend, out, frame = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
scene.cycles.filter_width = 0.01  # our tracer has one ray per pixel, through its centre
scene.cycles.samples = 1
scene.cycles.device = "CPU"
scene.render.threads_mode = "FIXED"
scene.render.threads = 1
scene.render.image_settings.color_depth = "16"
scene.frame_set(int(frame))
scene.render.filepath = out
bpy.ops.render.render(write_still=True)
