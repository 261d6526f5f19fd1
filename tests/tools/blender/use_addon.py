"""Installs the add-on and uses it: use_addon.py -- ADDON.zip OCTASPLAT SCENE.ply FOLDER.

Writes into the folder what the operators do: the scene as it came, with the octagons right of x = 0.3 moved,
the mesh of these, and the camera's path.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

addon, program, scene, folder = sys.argv[sys.argv.index("--") + 1 :]
folder = Path(folder)
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=addon, repo="user_default", enable_on_install=True)
preferences = bpy.context.preferences.addons["bl_ext.user_default.octasplat"].preferences
preferences.program = program
bpy.ops.import_scene.octasplat(filepath=scene)
(octagons,) = (item for item in bpy.data.objects if item.type == "MESH")
print("CAMERAS", bpy.context.scene.frame_end, [marker.name for marker in bpy.context.scene.timeline_markers])  # noqa: T201
bpy.ops.export_camera.octasplat(filepath=str(folder / "path.json"))
bpy.ops.export_scene.octasplat(filepath=str(folder / "same.ply"))

mesh = octagons.data
places = np.empty(3 * len(mesh.vertices), np.float32)
mesh.vertices.foreach_get("co", places)
places = places.reshape(-1, 3)
for which in ("ANY", "HALF", "ALL"):
    mesh.edges.foreach_set("select", np.zeros(len(mesh.edges), bool))
    mesh.polygons.foreach_set("select", np.zeros(len(mesh.polygons), bool))
    mesh.vertices.foreach_set("select", places[:, 0] > 0.3)
    bpy.context.view_layer.objects.active = octagons
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.octasplat.select_whole(which=which)
    bpy.ops.object.mode_set(mode="OBJECT")
    chosen = np.empty(len(mesh.vertices), bool)
    mesh.vertices.foreach_get("select", chosen)
    faces = np.empty(len(mesh.polygons), bool)
    mesh.polygons.foreach_get("select", faces)
    print("FACES", which, faces.sum())  # noqa: T201
    np.save(folder / f"{which}.npy", chosen)
places[chosen] += np.float32([0.0, 0.0, 2.0])
mesh.vertices.foreach_set("co", places.reshape(-1))
bpy.ops.export_scene.octasplat(filepath=str(folder / "moved.ply"))
bpy.ops.export_mesh.octasplat(filepath=str(folder / "moved.mesh.ply"))

for setting, value in (("program", "nowhere/octasplat"), ("scene", "gone.ply")):
    if setting == "program":
        preferences.program = value
    else:
        octagons["octasplat_scene"] = value
    try:
        bpy.ops.export_scene.octasplat(filepath=str(folder / "never.ply"))
    except RuntimeError as error:
        print("TOLD", error)  # noqa: T201
