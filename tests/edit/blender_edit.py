"""Run by Blender's own Python: imports a mesh, edits it and exports it, as a user would with the defaults.

Usage: python blender_edit.py IN OUT EDIT, where EDIT is none, twist, bend, move, delete, duplicate or weld.
"""

import sys
from pathlib import Path

import bpy  # isort: skip - makes bmesh importable
import bmesh

ANGLE = 1.0
"""Of the twist and the bend, radians."""


def load(path):
    before = set(bpy.data.objects)
    if path.suffix == ".ply":
        bpy.ops.wm.ply_import(filepath=str(path))
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    return [item for item in bpy.data.objects if item not in before and item.type == "MESH"]


def save(path):
    if path.suffix == ".ply":
        bpy.ops.wm.ply_export(filepath=str(path), export_attributes=True, apply_modifiers=True)
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_export(filepath=str(path), apply_modifiers=True)
    else:
        bpy.ops.export_scene.gltf(
            filepath=str(path), export_format="GLB", export_attributes=True, export_apply=True
        )


def simple_deform(item, method):
    modifier = item.modifiers.new("deform", "SIMPLE_DEFORM")
    modifier.deform_method = method
    modifier.deform_axis = "Z"
    modifier.angle = ANGLE


def change(item, edit):
    if edit in ("twist", "bend"):
        simple_deform(item, edit.upper())
        return
    mesh = bmesh.new()
    mesh.from_mesh(item.data)
    mesh.verts.ensure_lookup_table()
    right = [vertex for vertex in mesh.verts if vertex.co.x > 0.5]
    if edit == "move":
        for vertex in right:
            vertex.co.y += 2.0
    elif edit == "delete":
        bmesh.ops.delete(mesh, geom=right, context="VERTS")
    elif edit == "duplicate":
        faces = [face for face in mesh.faces if all(vertex.co.x > 0.5 for vertex in face.verts)]
        copied = bmesh.ops.duplicate(mesh, geom=faces + list({v for f in faces for v in f.verts}))
        moved = [part for part in copied["geom"] if isinstance(part, bmesh.types.BMVert)]
        bmesh.ops.translate(mesh, verts=moved, vec=(0.0, 0.0, 5.0))
    elif edit == "weld":
        bmesh.ops.remove_doubles(mesh, verts=list(mesh.verts), dist=0.02)
    mesh.to_mesh(item.data)
    mesh.free()


source, target, edit = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
bpy.ops.wm.read_factory_settings(use_empty=True)
for item in load(source):
    change(item, edit)
save(target)
