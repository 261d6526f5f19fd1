"""Writes the animation of Blender's camera as a path that ``octasplat render --path`` renders.

From a shell, with Blender 4.2 or later::

    blender -b shot.blend --python export_camera_path.py -- path.json

In Blender: Scripting > Open > this file, write where to behind ``PATH =`` below, Run Script.

The scene must stand as import_octasplat.py, or Blender's own import of a GLB, put it: not moved, turned or
scaled since. The frames are those between Start and End of the scene, the size is its resolution, the camera
its active one, whatever moves it (keys, constraints, a path to follow). What octasplat does not have is
refused: orthographic and panoramic cameras. Depth of field and motion blur are left out.
"""

import argparse
import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

PATH = ""
WORLD_FROM_BLENDER = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
"""Blender's x right, y forward, z up to COLMAP's x right, y down, z forward."""
BLENDER_CAM_FROM_CAM = Matrix.Diagonal((1, -1, -1, 1))
"""A camera of Blender looks along its -z axis with y up."""


def camera_of(scene):
    """The active camera; ends with a sentence if octasplat has none of its kind."""
    camera = scene.camera
    if camera is None:
        raise SystemExit("The scene has no active camera; add one, or choose it in the scene's properties.")
    if camera.data.type != "PERSP":
        raise SystemExit(f"{camera.name}: is {camera.data.type.lower()}; octasplat renders perspective ones.")
    return camera


def lens_px(camera, render, width, height):
    """Focal lengths and the principal point in pixels."""
    data, aspect = camera.data, render.pixel_aspect_y / render.pixel_aspect_x
    vertical = data.sensor_fit == "VERTICAL" or (data.sensor_fit == "AUTO" and height * aspect > width)
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    # The longer side, in units of the pixels' width, is what the sensor spans and what shifts are shares of.
    span = height * aspect if vertical else width
    fx = data.lens / sensor * span
    return {
        "fx": fx,
        "fy": fx / aspect,
        "cx": width / 2 - data.shift_x * span,
        "cy": height / 2 + data.shift_y * span / aspect,
    }


def pose_of(camera):
    """The camera-to-world matrix in octasplat's frames, without the scale that the camera may have."""
    place, turn, _ = camera.matrix_world.decompose()
    pose = WORLD_FROM_BLENDER @ Matrix.LocRotScale(place, turn, None) @ BLENDER_CAM_FROM_CAM
    return [list(row) for row in pose]


def write_path(path):
    """Write all frames of the active scene; returns how many."""
    scene = bpy.context.scene
    camera, render = camera_of(scene), scene.render
    share = render.resolution_percentage / 100
    width, height = (max(1, int(side * share)) for side in (render.resolution_x, render.resolution_y))
    frames, now = [], scene.frame_current
    for number in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(number)
        frames.append({"camera_to_world": pose_of(camera), **lens_px(camera, render, width, height)})
    scene.frame_set(now)
    content = {"width": width, "height": height, "fps": render.fps / render.fps_base, "frames": frames}
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=1), encoding="utf-8")
    partial.replace(path)
    return len(frames)


def main(arguments):
    """Write the path that the command line names."""
    parser = argparse.ArgumentParser(prog="export_camera_path.py", description="Blender's camera to JSON.")
    parser.add_argument("path", type=Path, help="the JSON file to write")
    parser.add_argument("--blend", type=Path, help="open this .blend first, where Blender runs as a module")
    given = parser.parse_args(arguments)
    if given.blend:
        bpy.ops.wm.open_mainfile(filepath=str(given.blend.resolve()))
    print(f"Wrote {given.path}: {write_path(given.path)} frames.")


if __name__ == "__main__":
    if "--" in sys.argv:
        main(sys.argv[sys.argv.index("--") + 1 :])
    elif PATH:
        write_path(Path(PATH))
    else:
        raise SystemExit("Name a file: write its path behind PATH = in this script, or see its first lines.")
