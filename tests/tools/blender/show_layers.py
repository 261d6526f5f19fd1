"""Prints the sockets that Blender's image node has for an EXR file."""

import sys

import bpy

image = bpy.data.images.load(sys.argv[sys.argv.index("--") + 1])
tree = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
node = tree.nodes.new("CompositorNodeImage")
node.image = image
sys.stdout.write(f"SOCKETS {sorted(output.name for output in node.outputs)}\n")
