"""Buffer layout of a GLB of octagons, and the JSON that describes it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from octasplat.engine.files.export_options import ExportCamera, ExportOptions
from octasplat.engine.files.glb_container import (
    ARRAY_BUFFER,
    CLAMP_TO_EDGE,
    CORE_NODE_NAME,
    ELEMENT_ARRAY_BUFFER,
    FLOAT,
    LINEAR,
    UNSIGNED_INT,
    ChannelAttribute,
    accessor_json,
    glb_size,
    json_bytes,
    light_rotation,
    pad_to_four,
    vector_type,
)
from octasplat.engine.files.glb_place import HALF_TURN_ABOUT_X, root_place, upright_root
from octasplat.engine.gaussians.octagon import FAN_TRIANGLES, SIDES
from octasplat.engine.shading.environment_frame import environment_frame

OPAQUE_CUTOFF = 0.2
"""``opaque``: a pixel is drawn where opacity times fall-off reaches this; best of 0.03 to 0.6 on a
trained scene (docs/opening/threejs.md)."""
# Takes as many characters in JSON as a float32 can.
WIDEST_NUMBER = float(np.float32(-1.1754943508222875e-38))

Bounds = tuple[list[float], list[float]]


@dataclass(frozen=True)
class Attribute:
    """A vertex attribute of glTF: its semantic and how many floats it has."""

    semantic: str
    width: int

    @property
    def type(self) -> str:
        """Return the glTF accessor type."""
        return vector_type(self.width)


OWN_ATTRIBUTES = (Attribute("POSITION", 3), Attribute("COLOR_0", 4), Attribute("TEXCOORD_0", 2))
GID = Attribute("_GID", 1)
LIT_ATTRIBUTES = (Attribute("NORMAL", 3), Attribute("TEXCOORD_1", 2))
"""Where light is to fall: the second coordinates look metallic and roughness up."""
CORNER = Attribute("_CORNER", 1)


class GlbLayout:
    """One file: the texture, the indices and the corner numbers (shared by all chunks), then the chunks.

    Attributes:
        largest: octagons in the largest chunk, for which the shared indices are made.
        length: bytes of the binary part.
        json_room: bytes kept for the JSON. It comes first in the file but holds the bounds of all vertices,
            so there is room for the longest numbers.
        total: bytes of the whole file.
    """

    def __init__(
        self,
        chunk_sizes: list[int],
        png_size: int,
        options: ExportOptions,
        extras: object,
        channels: Sequence[ChannelAttribute] = (),
        ramp_size: int = 0,
    ) -> None:
        """Plan a file of chunks of so many octagons; ``extras`` goes into the JSON's ``asset``.

        Of what is lit, ``ramp_size`` is the size of the image that materials are looked up in.
        """
        self._chunk_sizes = chunk_sizes
        self._options = options
        self._extras = extras
        self._attributes = (
            *OWN_ATTRIBUTES,
            *(LIT_ATTRIBUTES if options.light_up is not None else ()),
            *((GID,) if options.ids else ()),
            *(Attribute(channel.semantic, channel.width) for channel in channels),
        )
        self._views: list[dict[str, object]] = []
        self.largest = max(chunk_sizes)
        self.length = 0
        self._add_view(png_size)
        self._add_view(self.largest * len(FAN_TRIANGLES) * 3 * 4, target=ELEMENT_ARRAY_BUFFER)
        if options.ids:
            self._add_view(self.largest * SIDES * 4, target=ARRAY_BUFFER, byteStride=4)
        if options.light_up is not None:
            self._add_view(ramp_size)
        self._shared_views = len(self._views)
        for size in chunk_sizes:
            for attribute in self._attributes:
                self._add_view(size * SIDES * attribute.width * 4, target=ARRAY_BUFFER)
        widest = ([WIDEST_NUMBER] * 3, [WIDEST_NUMBER] * 3)
        self.json_room = pad_to_four(len(self.json([widest] * len(chunk_sizes))))
        self.total = glb_size(self.json_room, self.length)

    def _add_view(self, length: int, **keys: int) -> None:
        self._views.append({"buffer": 0, "byteOffset": self.length, "byteLength": length, **keys})
        self.length += pad_to_four(length)

    def json(self, bounds: list[Bounds]) -> bytes:
        """Return the JSON part, given each chunk's smallest and largest coordinates."""
        return json_bytes(self._gltf_document(bounds))

    def _gltf_document(self, bounds: list[Bounds]) -> dict[str, object]:
        accessors: list[dict[str, object]] = []
        meshes: list[dict[str, object]] = []
        for chunk, size in enumerate(self._chunk_sizes):
            used: dict[str, int] = {}
            first_view = self._shared_views + chunk * len(self._attributes)
            for place, attribute in enumerate(self._attributes):
                used[attribute.semantic] = len(accessors)
                accessors.append(accessor_json(first_view + place, FLOAT, size * SIDES, attribute.type))
            accessors[used["POSITION"]] |= {"min": bounds[chunk][0], "max": bounds[chunk][1]}
            if self._options.ids:
                used[CORNER.semantic] = len(accessors)
                # All chunks share view 2, the corner numbers, and view 1, the indices.
                accessors.append(accessor_json(2, FLOAT, size * SIDES, CORNER.type))
            accessors.append(accessor_json(1, UNSIGNED_INT, size * len(FAN_TRIANGLES) * 3, "SCALAR"))
            blended = {"attributes": used, "indices": len(accessors) - 1, "material": 0}
            solid = {**blended, "material": 1, "extras": {CORE_NODE_NAME: True}}
            meshes.append({"primitives": [blended] if self._options.cores is None else [solid, blended]})
        chunks = range(len(self._chunk_sizes))
        lit, facts = self._options.light_up is not None, self._options.facts
        turn = (
            light_rotation(environment_frame(np.array(self._options.light_up))) if lit else HALF_TURN_ABOUT_X
        )
        images = [{"name": "radial_alpha", "mimeType": "image/png", "bufferView": 0}]
        if lit:
            ramp = {"name": "materials", "mimeType": "image/png", "bufferView": self._shared_views - 1}
            images.append(ramp)
        nodes: list[dict[str, object]] = [
            {
                "name": "octasplat",
                "rotation": turn,
                "children": [1 + chunk for chunk in chunks],
                **(
                    root_place(facts.origin_world, facts.georeference, turn)
                    if self._options.turn_xyzw is None
                    else upright_root(self._options.turn_xyzw, facts.origin_world, facts.georeference)
                ),
            },
            *({"name": f"octagons_{chunk:02d}", "mesh": chunk} for chunk in chunks),
        ]
        cameras = [] if self._options.camera is None else [self._options.camera]
        if cameras:
            nodes[0]["children"] = list(range(1, len(nodes) + 1))
            nodes.append(_camera_node(cameras[0]))
        return {
            "asset": {"version": "2.0", "generator": "octasplat", "extras": self._extras},
            **({} if lit else {"extensionsUsed": ["KHR_materials_unlit"]}),
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            **({"cameras": [_camera_json(camera) for camera in cameras]} if cameras else {}),
            "meshes": meshes,
            "materials": [
                _material_json(OPAQUE_CUTOFF if self._options.opaque else None, lit),
                *(
                    []
                    if self._options.cores is None
                    else [_material_json(self._options.cores, lit, "octagon_cores")]
                ),
            ],
            "textures": [{"sampler": 0, "source": number} for number in range(len(images))],
            "samplers": [
                {"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
            ],
            "images": images,
            "accessors": accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self.length}],
        }


def _camera_node(camera: ExportCamera) -> dict[str, object]:
    place = {"translation": list(camera.position_world), "rotation": list(camera.rotation_xyzw)}
    return {"name": camera.name, "camera": 0, **place}


def _camera_json(camera: ExportCamera) -> dict[str, object]:
    lens = {"yfov": camera.yfov_rad, "aspectRatio": camera.aspect, "znear": camera.near_world}
    return {"name": camera.name, "type": "perspective", "perspective": lens}


def _material_json(cutoff: float | None, lit: bool, name: str = "octagons") -> dict[str, object]:
    transparency: dict[str, object] = {"alphaMode": "BLEND"}
    if cutoff is not None:
        transparency = {"alphaMode": "MASK", "alphaCutoff": cutoff}
    shading: dict[str, object] = {"baseColorTexture": {"index": 0}}
    if lit:
        shading["metallicRoughnessTexture"] = {"index": 1, "texCoord": 1}
    else:
        shading |= {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {
        "name": name,
        "pbrMetallicRoughness": shading,
        **({} if lit else {"extensions": {"KHR_materials_unlit": {}}}),
        **transparency,
        "doubleSided": True,
    }
