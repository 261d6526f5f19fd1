# SPDX-License-Identifier: Apache-2.0
"""Opens scenes of octasplat in Blender, and brings what was edited back to Gaussians.

File > Import > octasplat takes a scene or an octagon mesh, with the cameras of its run; the tab octasplat of
the sidebar selects whole octagons and saves the edited scene, by the program octasplat beside Blender.
``pack_addon.py`` makes the ZIP file that Blender installs.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from . import export_camera_path, import_octasplat

SCENE, MESH = "octasplat_scene", "octasplat_q"
"""Properties of imported objects: the file of the Gaussians, and what marks a mesh of octagons."""
VIEWS = "views.json"


class OctasplatError(Exception):
    """What a person is told in one sentence."""


def program(context):
    """The command octasplat."""
    stated = context.preferences.addons[__package__].preferences.program
    found = shutil.which(stated)
    if found is None:
        raise OctasplatError(f"There is no program {stated!r}; name octasplat's in the add-on's preferences.")
    return found


def run(context, *arguments):
    """Run a command of octasplat; returns what it wrote."""
    # Blender's own Python settings are none of the program's business.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(  # noqa: S603 - the person's own program
        [program(context), *map(str, arguments)],
        capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip
    if done.returncode:
        raise OctasplatError((done.stderr or done.stdout).strip() or "octasplat failed and did not say why.")
    return done.stdout


def reporting(execute):
    """An operator's work, whose errors become its report."""

    def reported(self, context):
        try:
            return execute(self, context)
        except (OctasplatError, SystemExit) as stop:
            self.report({"ERROR"}, str(stop))
            return {"CANCELLED"}

    return reported


def octagon_objects(context):
    """The selected meshes of octagons, or the only one there is."""
    every = [item for item in context.scene.objects if item.type == "MESH" and MESH in item]
    chosen = [item for item in every if item.select_get()] or every
    if len(chosen) != 1:
        raise OctasplatError("Select the one mesh of octagons that is meant, imported by File > Import.")
    return chosen[0]


def is_mesh(path):
    """Whether a PLY holds faces, as a mesh of octagons does."""
    return path.suffix.lower() == ".ply" and bool(import_octasplat.read_header(path)[2])


class OCTASPLAT_OT_import_scene(bpy.types.Operator, ImportHelper):
    """Open a scene of flat Gaussians, or a mesh of its octagons, as it looks in octasplat"""

    bl_idname = "import_scene.octasplat"
    bl_label = "Import octasplat scene"
    bl_options = {"UNDO"}

    filter_glob: StringProperty(default="*.ply;*.splat;*.spz;*.sog;*.glb", options={"HIDDEN"})
    cameras: BoolProperty(
        name="Cameras", default=True, description="An animated camera at the places of the photographs"
    )
    look: EnumProperty(
        name="Look", default="raw",
        items=[
            ("raw", "As rendered (Raw)", "Display values as they are: for this scene alone"),
            ("standard", "Among other things (Standard)", "The compositor turns the picture to light"),
            ("keep", "Leave settings", "Change neither renderer nor view"),
        ],
    )  # fmt: skip

    @reporting
    def execute(self, context):
        """Export the scene as a mesh where it is none, and import that."""
        source = Path(self.filepath)
        if not source.is_file():
            raise OctasplatError(f"{source}: there is no such file.")
        with tempfile.TemporaryDirectory() as folder:
            mesh = source
            if not is_mesh(source):
                mesh = Path(folder) / "scene.mesh.ply"
                run(context, "export", source, mesh, "--quiet")
            (octagons,) = import_octasplat.import_octagons(mesh)
        octagons.name = source.stem
        # A run has its Gaussians beside the mesh.
        scene = source.with_name("scene.ply") if mesh == source else source
        octagons[SCENE] = str(scene.resolve()) if scene.is_file() else ""
        if self.look != "keep":
            import_octasplat.set_up_scene(16, self.look)
        if self.cameras and source.with_name(VIEWS).is_file():
            import_octasplat.add_cameras(source.with_name(VIEWS))
        return {"FINISHED"}


class OCTASPLAT_OT_select_whole(bpy.types.Operator):
    """Let the selection hold every octagon as a whole or not at all"""

    bl_idname = "octasplat.select_whole"
    bl_label = "Select whole octagons"
    bl_options = {"REGISTER", "UNDO"}

    which: EnumProperty(
        name="Which", default="ANY",
        items=[
            ("ANY", "Touched", "Octagons of which a corner is selected"),
            ("HALF", "By half", "Octagons of which half of the corners are selected"),
            ("ALL", "Inside", "Octagons of which all corners are selected"),
        ],
    )  # fmt: skip

    @classmethod
    def poll(cls, context):
        """Where a mesh is active."""
        return context.object is not None and context.object.type == "MESH"

    def execute(self, context):
        """Count the selected vertices of each piece of the mesh."""
        item, mode = context.object, context.object.mode
        bpy.ops.object.mode_set(mode="OBJECT")  # which brings the selection into the mesh
        mesh = item.data
        chosen = np.empty(len(mesh.vertices), bool)
        mesh.vertices.foreach_get("select", chosen)
        pairs = np.empty(2 * len(mesh.edges), np.int32)
        mesh.edges.foreach_get("vertices", pairs)
        piece = pieces(len(chosen), pairs.reshape(-1, 2))
        share = np.bincount(piece, chosen) / np.maximum(np.bincount(piece), 1)
        whole = {"ANY": share > 0, "HALF": share >= 0.5, "ALL": share == 1}[self.which][piece]
        mesh.vertices.foreach_set("select", whole)
        mesh.edges.foreach_set("select", whole[pairs[::2]] & whole[pairs[1::2]])
        faces = np.empty(len(mesh.polygons), np.int32)
        mesh.polygons.foreach_get("loop_start", faces)
        corners = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        mesh.polygons.foreach_set("select", whole[corners[faces]])  # one corner stands for its piece
        bpy.ops.object.mode_set(mode=mode)
        self.report({"INFO"}, f"{len(np.unique(piece[whole]))} octagons")
        return {"FINISHED"}


def pieces(count, edges):
    """The least vertex of the piece of mesh that each vertex belongs to."""
    least = np.arange(count)
    while True:
        before = least.copy()
        np.minimum.at(least, edges[:, 0], least[edges[:, 1]])
        np.minimum.at(least, edges[:, 1], least[edges[:, 0]])
        if np.array_equal(least, before):
            return least


def write_mesh(context, octagons, path):
    """Write a mesh of octagons with its modifiers, along the axes of its scene."""
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for item in context.selected_objects:
        item.select_set(False)
    octagons.select_set(True)
    context.view_layer.objects.active = octagons
    bpy.ops.wm.ply_export(
        filepath=str(path), forward_axis="Z", up_axis="NEGATIVE_Y", apply_modifiers=True,
        export_selected_objects=True, export_uv=True, export_colors="LINEAR", export_attributes=True,
        export_triangulated_mesh=False,
    )  # fmt: skip


class OCTASPLAT_OT_save_scene(bpy.types.Operator, ExportHelper):
    """Bring the edited octagons back to Gaussians: octasplat edit"""

    bl_idname = "export_scene.octasplat"
    bl_label = "Save octasplat scene"

    filename_ext = ".ply"
    filter_glob: StringProperty(default="*.ply;*.splat;*.spz;*.sog;*.glb", options={"HIDDEN"})
    check_extension = None  # other formats of splats are as good
    whole_octagons: BoolProperty(
        name="Whole octagons", description="Octagons that moved in part move as a whole or not at all"
    )

    @reporting
    def execute(self, context):
        """Write the mesh to a temporary folder and let the program read it."""
        octagons, target = octagon_objects(context), Path(self.filepath)
        scene = octagons.get(SCENE, "")
        if not Path(scene).is_file():
            raise OctasplatError(
                f"The Gaussians of {octagons.name} ({scene or 'unknown'}) are not there; "
                f"name their file in the object's property {SCENE}."
            )
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder) / "edited.ply"
            write_mesh(context, octagons, mesh)
            options = ["--whole-octagons"] if self.whole_octagons else []
            said = run(context, "edit", scene, "--mesh", mesh, "-o", target, *options)
        for line in said.splitlines():
            if line.strip():
                self.report({"WARNING" if "Warning" in line else "INFO"}, line.strip())
        return {"FINISHED"}


class OCTASPLAT_OT_save_mesh(bpy.types.Operator, ExportHelper):
    """Write the edited octagons as a mesh that octasplat edit --mesh reads"""

    bl_idname = "export_mesh.octasplat"
    bl_label = "Save octagon mesh"

    filename_ext = ".ply"
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})

    @reporting
    def execute(self, context):
        """Write it."""
        write_mesh(context, octagon_objects(context), Path(self.filepath))
        return {"FINISHED"}


class OCTASPLAT_OT_save_path(bpy.types.Operator, ExportHelper):
    """Write the camera's animation as a path that octasplat render --path takes"""

    bl_idname = "export_camera.octasplat"
    bl_label = "Save camera path"

    filename_ext = ".json"
    filter_glob: StringProperty(default="*.json", options={"HIDDEN"})

    @reporting
    def execute(self, context):
        """Write it."""
        frames = export_camera_path.write_path(Path(self.filepath))
        self.report({"INFO"}, f"{frames} frames")
        return {"FINISHED"}


class OCTASPLAT_PT_tools(bpy.types.Panel):
    """The tab in the sidebar of the 3D view"""

    bl_label = "octasplat"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "octasplat"

    def draw(self, context):
        """A button each."""
        column = self.layout.column()
        column.operator(OCTASPLAT_OT_import_scene.bl_idname, icon="IMPORT")
        column.operator_menu_enum(OCTASPLAT_OT_select_whole.bl_idname, "which", icon="RESTRICT_SELECT_OFF")
        column.operator(OCTASPLAT_OT_save_scene.bl_idname, icon="EXPORT")
        column.operator(OCTASPLAT_OT_save_mesh.bl_idname, icon="MESH_DATA")
        column.operator(OCTASPLAT_OT_save_path.bl_idname, icon="CAMERA_DATA")


class OctasplatPreferences(bpy.types.AddonPreferences):
    """Where the program is."""

    bl_idname = __package__
    program: StringProperty(name="octasplat", default="octasplat", subtype="FILE_PATH")

    def draw(self, context):
        """The one setting."""
        self.layout.prop(self, "program")


def import_entry(menu, context):
    """In File > Import."""
    menu.layout.operator(OCTASPLAT_OT_import_scene.bl_idname, text="octasplat (scene, octagon mesh)")


def export_entry(menu, context):
    """In File > Export."""
    menu.layout.operator(OCTASPLAT_OT_save_scene.bl_idname, text="octasplat (edited scene)")
    menu.layout.operator(OCTASPLAT_OT_save_mesh.bl_idname, text="octasplat (octagon mesh)")


CLASSES = (
    OctasplatPreferences,
    OCTASPLAT_OT_import_scene,
    OCTASPLAT_OT_select_whole,
    OCTASPLAT_OT_save_scene,
    OCTASPLAT_OT_save_mesh,
    OCTASPLAT_OT_save_path,
    OCTASPLAT_PT_tools,
)


def register():
    """Called by Blender."""
    for made in CLASSES:
        bpy.utils.register_class(made)
    bpy.types.TOPBAR_MT_file_import.append(import_entry)
    bpy.types.TOPBAR_MT_file_export.append(export_entry)


def unregister():
    """Called by Blender."""
    bpy.types.TOPBAR_MT_file_import.remove(import_entry)
    bpy.types.TOPBAR_MT_file_export.remove(export_entry)
    for made in reversed(CLASSES):
        bpy.utils.unregister_class(made)
