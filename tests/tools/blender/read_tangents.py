"""Tangents of a GLB in the world as Blender works them out: read_tangents.py -- FILE.glb OUT.npz."""

import sys

import bpy
import numpy as np

source, target = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
(thing,) = (thing for thing in bpy.data.objects if thing.type == "MESH")
mesh = thing.data
mesh.calc_tangents()
turn = np.array(thing.matrix_world.to_3x3())
np.savez(
    target,
    triangles=len(mesh.polygons),
    tangents=np.array([loop.tangent for loop in mesh.loops]) @ turn.T,
    signs=np.array([loop.bitangent_sign for loop in mesh.loops]),
    uv=np.array([entry.uv for entry in mesh.uv_layers[0].data]),
)
