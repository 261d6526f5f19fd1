"""Imports a mesh and exports it unchanged: round_trip.py -- IN OUT, both of one format."""

import sys

import bpy

source, target = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
kind = source.rpartition(".")[2]
if kind == "blend":  # as import_octasplat.py made it: exported with the axes that it tells users to choose
    bpy.ops.wm.open_mainfile(filepath=source)
    bpy.ops.wm.ply_export(
        filepath=target,
        export_colors="LINEAR",
        export_attributes=True,
        forward_axis="Z",
        up_axis="NEGATIVE_Y",
    )
elif kind == "ply":
    bpy.ops.wm.ply_import(filepath=source, import_colors="LINEAR")
    bpy.ops.wm.ply_export(filepath=target, export_colors="LINEAR", export_attributes=True)
elif kind == "obj":
    bpy.ops.wm.obj_import(filepath=source)
    bpy.ops.wm.obj_export(filepath=target, export_colors=True)
else:
    bpy.ops.import_scene.gltf(filepath=source)
    bpy.ops.export_scene.gltf(filepath=target, export_normals=False, export_attributes=True)
