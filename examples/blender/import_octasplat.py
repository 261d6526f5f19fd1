"""Opens an octagon mesh of octasplat, a mesh PLY or a GLB, in Blender, looking as octasplat renders it.

From a shell, with Blender 4.2 or later, to make a .blend that opens with a click::

    blender -b --python import_octasplat.py -- scene.mesh.ply scene.blend
    blender -b --python import_octasplat.py -- scene.mesh.ply scene.blend --cameras path.json --render out.png

In Blender: Scripting > Open > this file, write the path of a mesh behind ``MESH =`` below, Run Script.

What it sets, and why:

* Colors are composited as display values, so the mesh emits them as if they were light (those of a GLB,
  which are linear, go through sRGB's curve first), and the view transform is Raw. With ``--view standard`` it
  is Standard, for scenes with other things in them, and the compositor turns the picture into light after it
  was blended (Convert Colorspace, from sRGB to Linear Rec.709): the same picture.
* The fall-off of a Gaussian comes from the texture coordinates: opacity * exp(-Q/2 |2 uv - 1|^2).
* Each ray may pass 256 transparent octagons, and is not ended early by chance (Cycles does so by default).
* The object is turned upright: the scene's y points down, Blender's z points up. Export with
  "Forward: Z" and "Up: -Y" to get the file's own axes back; ``octasplat edit`` finds out by itself.
"""

import argparse
import json
import math
import struct
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

MESH = ""
DEFAULT_Q = 9.210340371976184
TRANSPARENT_BOUNCES = 256
SENSOR_MM = 36.0
BLENDER_FROM_WORLD = Matrix(((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))
"""COLMAP's x right, y down, z forward to Blender's x right, y forward, z up."""
BLENDER_CAM_FROM_CAM = Matrix.Diagonal((1, -1, -1, 1))
"""A camera of Blender looks along its -z axis with y up."""


def read_header(path):
    """Names of a PLY's vertex properties, its comments, and whether it has faces."""
    names, comments, faces, element = [], [], 0, ""
    with path.open("rb") as handle:
        if handle.readline().strip() != b"ply":
            raise SystemExit(f"{path}: is not a PLY file; name the octagons.ply of a run.")
        for line in handle:
            words = line.decode("utf-8", "replace").split()
            if not words:
                continue
            if words[0] == "end_header":
                return names, comments, faces
            if words[0] == "element":
                element = words[1]
                faces = int(words[2]) if element == "face" else faces
            elif words[0] == "property" and element == "vertex":
                names.append(words[-1])
            elif words[0] == "comment":
                comments.append(words[1:])
    raise SystemExit(f"{path}: the PLY header never ends; the file is damaged.")


def check(path):
    """The quantile Q of an octagon mesh; ends with a sentence if the file is something else."""
    if not path.is_file():
        raise SystemExit(f"{path}: there is no such file.")
    names, comments, faces = read_header(path)
    if "f_dc_0" in names or not faces:
        mesh = path.with_suffix(".mesh.ply")
        raise SystemExit(f"{path}: holds points, not a mesh; first run: octasplat export {path} {mesh}")
    if not {"s", "t", "red", "alpha"} <= set(names):
        raise SystemExit(f"{path}: has no texture coordinates or colors; export it with octasplat.")
    stated = [words[1] for words in comments if len(words) == 2 and words[0] == "octasplat_q"]
    return float(stated[0]) if stated else DEFAULT_Q


def check_glb(path):
    """The quantile Q of a GLB of octagons; ends with a sentence if the file is something else."""
    if not path.is_file():
        raise SystemExit(f"{path}: there is no such file.")
    with path.open("rb") as handle:
        start = handle.read(20)
        if len(start) < 20 or start[:4] != b"glTF":
            raise SystemExit(f"{path}: is not a GLB file; name the octagons.glb of a run.")
        try:
            document = json.loads(handle.read(struct.unpack_from("<I", start, 12)[0]))
            q = float(document["asset"]["extras"]["octasplat_q"])
        except (ValueError, KeyError, TypeError):
            raise SystemExit(f"{path}: holds no octagons; import it by File > Import > glTF.") from None
    if "KHR_materials_unlit" not in document.get("extensionsUsed", []):
        raise SystemExit(f"{path}: is to be lit, as any glTF; import it by File > Import > glTF.")
    return q


def clear_scene():
    """An empty file without the cube."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def import_octagons(path):
    """Import the mesh with its material, upright; returns its objects, one of a PLY."""
    if path.suffix.lower() == ".glb":
        return import_glb(path)
    q = check(path)
    before = set(bpy.data.objects)
    bpy.ops.wm.ply_import(
        filepath=str(path), import_colors="LINEAR", import_attributes=True, forward_axis="Y", up_axis="Z"
    )
    (octagons,) = set(bpy.data.objects) - before
    set_material(octagons, octagon_material(q, octagons.data.color_attributes[0].name), q)
    upright = bpy.data.objects.new("octasplat_upright", None)
    bpy.context.scene.collection.objects.link(upright)
    octagons.parent = upright
    octagons.matrix_parent_inverse = BLENDER_FROM_WORLD  # a matrix, not angles: exact, and undone exactly
    return [octagons]


def import_glb(path):
    """The chunks of a GLB, which come upright."""
    q = check_glb(path)
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(path))
    chunks = [made for made in bpy.data.objects if made not in before and made.type == "MESH"]
    material = octagon_material(q, chunks[0].data.color_attributes[0].name, linear=True)
    for chunk in chunks:
        set_material(chunk, material, q)
    return chunks


def set_material(octagons, material, q):
    """Give an object its material, and say what it is."""
    octagons.data.materials.clear()
    octagons.data.materials.append(material)
    octagons["octasplat_q"] = q


def octagon_material(q, colors, linear=False):
    """Emission of display colors, mixed with transparency by the Gaussian's alpha.

    With ``linear`` the color attribute is linear and goes through sRGB's curve.
    """
    material = bpy.data.materials.new("octagons")
    if not material.node_tree:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()

    def node(kind, inputs=(), **settings):
        made = tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(made, name, value)
        for place, source in inputs:
            if hasattr(source, "is_output"):
                tree.links.new(source, made.inputs[place])
            else:
                made.inputs[place].default_value = source
        return made

    def maths(operation, *inputs):
        return node("ShaderNodeMath", tuple(enumerate(inputs)), operation=operation).outputs[0]

    def vectors(operation, *inputs):
        return node("ShaderNodeVectorMath", tuple(enumerate(inputs)), operation=operation)

    def display(value):
        """12.92 v where v is at most 0.0031308, else 1.055 v^(1 / 2.4) - 0.055."""
        low = maths("MULTIPLY", value, 12.92)
        high = maths("MULTIPLY_ADD", maths("POWER", value, 1.0 / 2.4), 1.055, -0.055)
        bright = maths("GREATER_THAN", value, 0.0031308)
        return maths("ADD", low, maths("MULTIPLY", bright, maths("SUBTRACT", high, low)))

    uv = node("ShaderNodeUVMap", uv_map="UVMap").outputs["UV"]
    offset = vectors("SUBTRACT", uv, (0.5, 0.5, 0.0)).outputs["Vector"]
    square = vectors("DOT_PRODUCT", offset, offset).outputs["Value"]
    fall_off = maths("EXPONENT", maths("MULTIPLY", square, -2.0 * q))
    color = node("ShaderNodeAttribute", attribute_type="GEOMETRY", attribute_name=colors)
    alpha = maths("MULTIPLY", fall_off, color.outputs["Alpha"])
    shown = color.outputs["Color"]
    if linear:
        parts = node("ShaderNodeSeparateColor", [(0, shown)]).outputs
        shown = node("ShaderNodeCombineColor", [(k, display(parts[k])) for k in range(3)]).outputs[0]
    glow = node("ShaderNodeEmission", [("Color", shown), ("Strength", 1.0)])
    clear = node("ShaderNodeBsdfTransparent")
    mix = node(
        "ShaderNodeMixShader",
        [(0, alpha), (1, clear.outputs["BSDF"]), (2, glow.outputs["Emission"])],
    )
    node("ShaderNodeOutputMaterial", [("Surface", mix.outputs["Shader"])])
    material.use_backface_culling = False
    return material


def set_up_scene(samples, view="raw"):
    """Cycles for transparency, display values as they are (``view``: raw or standard), black behind."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples = samples
    cycles.use_denoising = False
    cycles.use_adaptive_sampling = False
    cycles.max_bounces = 0
    cycles.transparent_max_bounces = TRANSPARENT_BOUNCES
    cycles.min_transparent_bounces = TRANSPARENT_BOUNCES
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Raw" if view == "raw" else "Standard"
    scene.view_settings.look = "None"
    if view == "standard":
        light_after_blending(scene)
    world = bpy.data.worlds.new("black")
    if not world.node_tree:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    scene.world = world
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                area.spaces[0].shading.type = "MATERIAL"


def light_after_blending(scene):
    """Let the compositor turn rendered display values into light, which the Standard view turns back."""
    if hasattr(scene, "compositing_node_group"):  # Blender 5
        tree = bpy.data.node_groups.new("octasplat", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        scene.compositing_node_group = tree
        output = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("CompositorNodeComposite")
    scene.render.use_compositing = True
    rendered = tree.nodes.new("CompositorNodeRLayers")
    convert = tree.nodes.new("CompositorNodeConvertColorSpace")
    convert.from_color_space, convert.to_color_space = "sRGB", "Linear Rec.709"
    tree.links.new(rendered.outputs["Image"], convert.inputs[0])
    tree.links.new(convert.outputs[0], output.inputs[0])


def path_of_views(content):
    """The places of a run's photographs (its ``views.json``) as a camera path, without distortion."""
    width, height = (content["views"][0][name] for name in ("width_px", "height_px"))
    frames = []
    for view in content["views"]:
        camera = content["cameras"][view["camera"]]
        if camera["model"] == "EQUIRECTANGULAR":
            raise SystemExit(
                f"{view['name']}: is a panorama, which Blender's cameras do not show; leave them out."
            )
        single = camera["model"].startswith(("SIMPLE_", "RADIAL"))
        fx, fy, cx, cy = [camera["params"][0], *camera["params"][:3]] if single else camera["params"][:4]
        across, down = width / camera["width_px"], height / camera["height_px"]
        from_world = Matrix.Translation(view["translation_cam_from_world"])
        from_world @= Matrix(view["rotation_cam_from_world"]).to_4x4()
        frames.append(
            {
                "camera_to_world": [list(row) for row in from_world.inverted()],
                "fx": fx * across, "fy": fy * down, "cx": cx * across, "cy": cy * down,
            }
        )  # fmt: skip
    return {
        "width": width,
        "height": height,
        "frames": frames,
        "names": [v["name"] for v in content["views"]],
    }


def add_cameras(path):
    """One camera that takes the poses of a camera path (as ``octasplat render --path``) frame by frame.

    The ``views.json`` of a run will do, too: its photographs' places, each a marker with its name.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if "views" in content:
        content = path_of_views(content)
    for number, name in enumerate(content.get("names", ()), 1):
        bpy.context.scene.timeline_markers.new(name, frame=number)
    width, height = content["width"], content["height"]
    scene, camera = bpy.context.scene, new_camera()
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.fps = max(1, round(content.get("fps", 30)))
    poses = content.get("frames") or content["keys"]
    # Between the keys of a path Blender goes its own way, with the same keys at the same times.
    frames = max(len(poses), round(content.get("seconds", 0) * scene.render.fps))
    scene.frame_start, scene.frame_end = 1, frames
    camera.rotation_mode = "QUATERNION"
    last = None
    for place, frame in enumerate(poses):
        number = 1 + round(place * (frames - 1) / max(1, len(poses) - 1))
        if "fov_y_degrees" in frame:
            fx = fy = height / 2 / math.tan(math.radians(frame["fov_y_degrees"]) / 2)
        else:
            fx, fy = frame["fx"], frame["fy"]
        # Blender has one focal length; pixels that are not square make up for the other.
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = 1.0, fx / fy
        camera.data.lens = fx * SENSOR_MM / width
        camera.data.shift_x = (width / 2 - frame.get("cx", width / 2)) / width
        camera.data.shift_y = (frame.get("cy", height / 2) - height / 2) / width * fx / fy
        pose = BLENDER_FROM_WORLD @ Matrix(frame["camera_to_world"]) @ BLENDER_CAM_FROM_CAM
        camera.location = pose.to_translation()
        turn = pose.to_quaternion()
        if last is not None:
            turn.make_compatible(last)
        camera.rotation_quaternion = last = turn
        for channel in ("location", "rotation_quaternion"):
            camera.keyframe_insert(channel, frame=number)
        for channel in ("lens", "shift_x", "shift_y"):
            camera.data.keyframe_insert(channel, frame=number)
    scene.frame_set(1)


def add_default_camera(octagons):
    """A camera in front of the middle half of the vertices, which distant background does not move."""
    places = []
    for item in octagons:
        flat = [0.0] * (3 * len(item.data.vertices))
        item.data.vertices.foreach_get("co", flat)
        places += flat
    ranges = []
    for axis in range(3):
        values = sorted(places[axis::3])
        count = len(values)
        ranges.append((values[count // 4], values[count // 2], values[(3 * count) // 4]))
    bpy.context.view_layer.update()
    centre = octagons[0].matrix_world @ Vector([middle for _, middle, _ in ranges])
    size = max(max(high - low for low, _, high in ranges), 1e-6)
    camera = new_camera()
    camera.location = centre + Vector((0.0, -4.0, 1.0)) * size
    camera.rotation_mode = "QUATERNION"
    camera.rotation_quaternion = (centre - camera.location).to_track_quat("-Z", "Y")
    camera.data.clip_end = 1000 * size


def new_camera():
    """An active camera with a horizontal sensor."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    data.clip_start, data.clip_end = 1e-3, 1e6
    camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def main(arguments):
    """Make the .blend, and the images if asked for."""
    parser = argparse.ArgumentParser(prog="import_octasplat.py", description="Octagon meshes into Blender.")
    parser.add_argument("mesh", type=Path, help="octagons.ply or .glb of a run, or an export of either")
    parser.add_argument("blend", type=Path, help="the .blend to write")
    parser.add_argument(
        "--cameras", type=Path, help="a camera path in JSON, as octasplat render --path takes"
    )
    parser.add_argument("--samples", type=int, default=16, help="Cycles samples per pixel (default: 16)")
    parser.add_argument(
        "--view", choices=("raw", "standard"), default="raw", help="the view transform (default: raw)"
    )
    parser.add_argument("--render", type=Path, help="also render the first frame to this PNG")
    given = parser.parse_args(arguments)
    (check_glb if given.mesh.suffix.lower() == ".glb" else check)(given.mesh)
    clear_scene()
    octagons = import_octagons(given.mesh)
    set_up_scene(given.samples, given.view)
    if given.cameras:
        add_cameras(given.cameras)
    else:
        add_default_camera(octagons)
    bpy.ops.wm.save_as_mainfile(filepath=str(given.blend.resolve()), compress=True)
    if given.render:
        bpy.context.scene.render.filepath = str(given.render.resolve())
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    if "--" in sys.argv:
        main(sys.argv[sys.argv.index("--") + 1 :])
    elif MESH:
        set_up_scene(16)
        import_octagons(Path(MESH))
    else:
        raise SystemExit("Name a mesh: write its path behind MESH = in this script, or see its first lines.")
