"""Bindings of the Embree functions that the tracers need, from the library in the embreex wheel.

Nothing is compiled at install: the wheel's extension module links Embree, so that its symbols resolve
through the loaded module.
"""

import ctypes
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from octasplat.engine.core.errors import OctasplatError

_GEOMETRY_TYPE_TRIANGLE, _GEOMETRY_TYPE_USER = 0, 120
_SCENE_ROBUST = 4
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_FORMAT_UINT3, _FORMAT_FLOAT3 = 0x5003, 0x9003
_ERROR_NAMES = {1: "unknown error", 2: "invalid argument", 3: "invalid operation", 4: "out of memory",
                5: "unsupported CPU", 6: "cancelled"}  # fmt: skip

Handle = ctypes.c_void_p

_SIGNATURES: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (Handle, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [Handle]),
    "rtcGetDeviceError": (ctypes.c_int, [Handle]),
    "rtcNewScene": (Handle, [Handle]),
    "rtcReleaseScene": (None, [Handle]),
    "rtcSetSceneFlags": (None, [Handle, ctypes.c_int]),
    "rtcSetSceneBuildQuality": (None, [Handle, ctypes.c_int]),
    "rtcJoinCommitScene": (None, [Handle]),
    "rtcAttachGeometry": (ctypes.c_uint, [Handle, Handle]),
    "rtcNewGeometry": (Handle, [Handle, ctypes.c_int]),
    "rtcReleaseGeometry": (None, [Handle]),
    "rtcCommitGeometry": (None, [Handle]),
    "rtcSetGeometryBuildQuality": (None, [Handle, ctypes.c_int]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [Handle, ctypes.c_int, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, *[ctypes.c_size_t] * 3],
    ),
    "rtcSetGeometryUserPrimitiveCount": (None, [Handle, ctypes.c_uint]),
    "rtcSetGeometryUserData": (None, [Handle, ctypes.c_void_p]),
    "rtcSetGeometryBoundsFunction": (None, [Handle, ctypes.c_void_p, ctypes.c_void_p]),
    "rtcSetGeometryIntersectFunction": (None, [Handle, ctypes.c_void_p]),
    "rtcSetGeometryOccludedFunction": (None, [Handle, ctypes.c_void_p]),
}


class EmbreeError(OctasplatError):
    """Embree refused a call; a fault of the installation or of memory, not of the data."""


@cache
def load_library() -> ctypes.CDLL:
    """Return the loaded Embree with argument types set.

    Raises:
        EmbreeError: the embreex package carries no Embree 4.
    """
    from embreex import rtcore_scene

    lib = ctypes.CDLL(rtcore_scene.__file__)
    try:
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(lib, name)
            function.restype, function.argtypes = result, arguments
    except AttributeError as error:
        raise EmbreeError(
            f"embreex carries no usable Embree 4 ({error}); reinstall it with: pip install embreex"
        ) from None
    return lib


@cache
def intersect1_address() -> int:
    """Return the address of rtcIntersect1, passed to kernels at run time so that they can be cached."""
    return _function_address("rtcIntersect1")


@cache
def occluded1_address() -> int:
    """Return the address of rtcOccluded1, which stops at any hit."""
    return _function_address("rtcOccluded1")


@cache
def intersect8_address() -> int:
    """Return the address of rtcIntersect8, for eight rays through triangles."""
    return _function_address("rtcIntersect8")


@cache
def occluded8_address() -> int:
    """Return the address of rtcOccluded8."""
    return _function_address("rtcOccluded8")


def _function_address(name: str) -> int:
    address = ctypes.cast(getattr(load_library(), name), ctypes.c_void_p).value
    assert address is not None
    return address


class EmbreeDevice:
    """An Embree device; ``threads`` = 0 lets it use every core for building."""

    def __init__(self, threads: int = 0) -> None:
        self._lib = load_library()
        self.handle = self._lib.rtcNewDevice(f"threads={threads}".encode())
        if not self.handle:
            raise EmbreeError(
                f"Embree could not start: {_ERROR_NAMES.get(self._lib.rtcGetDeviceError(None), '?')}"
            )

    def check(self, action: str) -> None:
        """Raise an error if the last calls failed.

        Raises:
            EmbreeError: naming what was being done.
        """
        code = self._lib.rtcGetDeviceError(self.handle)
        if code:
            raise EmbreeError(f"Embree failed while {action}: {_ERROR_NAMES.get(code, code)}")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._lib.rtcReleaseDevice(self.handle)


class _EmbreeScene:
    """A bounding-volume hierarchy over one geometry; rays are traced through its ``handle``."""

    def __init__(self, device: EmbreeDevice, quality: int) -> None:
        self._device, self._quality = device, quality
        self._lib = device._lib
        self.handle = self._lib.rtcNewScene(device.handle)
        self._lib.rtcSetSceneBuildQuality(self.handle, quality)

    def _build(self, geometry: int, count: int, primitive_name: str) -> None:
        """Build over the finished geometry.

        Raises:
            EmbreeError: memory ran out.
        """
        lib = self._lib
        lib.rtcSetGeometryBuildQuality(geometry, self._quality)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometry(self.handle, geometry)
        lib.rtcReleaseGeometry(geometry)  # the scene holds the geometry now
        # Joined, since rtcCommitScene on one thread leaves another of TBB's spinning for ever.
        lib.rtcJoinCommitScene(self.handle)
        self._device.check(f"building the hierarchy over {count} {primitive_name}")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._lib.rtcReleaseScene(self.handle)


class EmbreeBoxScene(_EmbreeScene):
    """A hierarchy over boxes that a callback intersects.

    The callbacks' addresses and ``boxes_address`` (n rows of lower and upper corner, six float32) must
    stay valid for the life of the scene.
    """

    def __init__(
        self,
        device: EmbreeDevice,
        count: int,
        boxes_address: int,
        bounds_callback: int,
        intersect_callback: int,
        occluded_callback: int,
        *,
        quality: int = 1,
    ) -> None:
        super().__init__(device, quality)
        lib = self._lib
        geometry = lib.rtcNewGeometry(device.handle, _GEOMETRY_TYPE_USER)
        lib.rtcSetGeometryUserPrimitiveCount(geometry, count)
        lib.rtcSetGeometryUserData(geometry, boxes_address)
        lib.rtcSetGeometryBoundsFunction(geometry, bounds_callback, None)
        lib.rtcSetGeometryIntersectFunction(geometry, intersect_callback)
        lib.rtcSetGeometryOccludedFunction(geometry, occluded_callback)
        self._build(geometry, count, "Gaussians")


class EmbreeTriangleScene(_EmbreeScene):
    """A hierarchy over triangles, which Embree intersects; the arrays are copied.

    Where it ``is_watertight`` no ray slips through between triangles that share an edge.
    """

    def __init__(
        self,
        device: EmbreeDevice,
        vertices_world: Float[np.ndarray, "v 3"],
        faces: Int[np.ndarray, "f 3"],
        *,
        quality: int = 1,
        is_watertight: bool = True,
    ) -> None:
        super().__init__(device, quality)
        if is_watertight:
            self._lib.rtcSetSceneFlags(self.handle, _SCENE_ROBUST)
        # Embree reads 16 bytes at each vertex, past the end of the last one.
        self._vertices = np.zeros((len(vertices_world) + 1, 3), np.float32)
        self._vertices[:-1] = vertices_world
        self._faces = np.array(faces, np.uint32, order="C")
        geometry = self._lib.rtcNewGeometry(device.handle, _GEOMETRY_TYPE_TRIANGLE)
        for kind, item_format, array, count in (
            (_BUFFER_VERTEX, _FORMAT_FLOAT3, self._vertices, len(vertices_world)),
            (_BUFFER_INDEX, _FORMAT_UINT3, self._faces, len(faces)),
        ):
            self._lib.rtcSetSharedGeometryBuffer(
                geometry, kind, 0, item_format, array.ctypes.data, 0, 12, count
            )
        self._build(geometry, len(faces), "triangles")
