"""The table of files that a reconstruction writes besides its scene: names, formats, and what opens them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ResultFile:
    """One file that a run writes unless other files are asked for.

    Attributes:
        name: in the folder of the run.
        format: name of its format in the registry of formats.
        label: what it is, in one word, before its path.
        opens_in: what opens it, and what it is for.
        earlier_name: its name in runs of earlier versions; empty where they had no such file.
    """

    name: str
    format: str
    label: str
    opens_in: str
    earlier_name: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return its name, and that in runs of earlier versions if it had one."""
        return (self.name, self.earlier_name) if self.earlier_name else (self.name,)


VIEWER_GLB = ResultFile(
    "viewer.glb",
    "viewer-glb",
    "Viewer",
    "Blender, three.js, model-viewer, any glTF viewer: to look at, with what was photographed in the frame",
)
SURFACE_GLB = ResultFile(
    "surface.glb",
    "surface",
    "Surface",
    "Blender, Unity, Unreal Engine, any glTF viewer: one textured mesh of opaque triangles",
)
OCTAGONS_PLY = ResultFile(
    "octagons.ply",
    "mesh-ply",
    "Octagons",
    "Blender, MeshLab, CloudCompare: for editing, as it keeps every Gaussian's number",
    "mesh.ply",
)
OCTAGONS_OBJ = ResultFile(
    "octagons.obj",
    "obj",
    "Octagons",
    "Blender, MeshLab, most 3D programs: for editing, geometry and colors without opacity",
    "mesh.obj",
)
OCTAGONS_GLB = ResultFile(
    "octagons.glb",
    "glb",
    "Octagons",
    "Blender: for editing, with opacity and fall-off; in viewers that do not sort triangles it shows haze",
    "mesh.glb",
)
RESULT_FILES = (VIEWER_GLB, SURFACE_GLB, OCTAGONS_PLY, OCTAGONS_OBJ, OCTAGONS_GLB)
"""In the order in which they are offered."""
DEFAULT_EXPORTS = tuple(file.name for file in RESULT_FILES)


def file_label(name: str) -> str:
    """Return what a file of a run is, in one word; ``Export`` for those that are not in the table."""
    return next((file.label for file in RESULT_FILES if name in file.names), "Export")
