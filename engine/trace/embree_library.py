"""The few functions of Embree that the tracer needs, taken from the library inside the embreex wheel.

Nothing is compiled at install: the wheel's extension module links Embree, so that its symbols resolve
through the loaded module.
"""

import ctypes
from functools import cache

from engine.errors import OctasplatError

_GEOMETRY_TYPE_USER = 120
_ERROR_NAMES = {1: "unknown error", 2: "invalid argument", 3: "invalid operation", 4: "out of memory",
                5: "unsupported CPU", 6: "cancelled"}  # fmt: skip

Handle = ctypes.c_void_p

_SIGNATURES: dict[str, tuple[object, list[object]]] = {
    "rtcNewDevice": (Handle, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [Handle]),
    "rtcGetDeviceError": (ctypes.c_int, [Handle]),
    "rtcNewScene": (Handle, [Handle]),
    "rtcReleaseScene": (None, [Handle]),
    "rtcSetSceneBuildQuality": (None, [Handle, ctypes.c_int]),
    "rtcCommitScene": (None, [Handle]),
    "rtcAttachGeometry": (ctypes.c_uint, [Handle, Handle]),
    "rtcNewGeometry": (Handle, [Handle, ctypes.c_int]),
    "rtcReleaseGeometry": (None, [Handle]),
    "rtcCommitGeometry": (None, [Handle]),
    "rtcSetGeometryBuildQuality": (None, [Handle, ctypes.c_int]),
    "rtcSetGeometryUserPrimitiveCount": (None, [Handle, ctypes.c_uint]),
    "rtcSetGeometryUserData": (None, [Handle, ctypes.c_void_p]),
    "rtcSetGeometryBoundsFunction": (None, [Handle, ctypes.c_void_p, ctypes.c_void_p]),
    "rtcSetGeometryIntersectFunction": (None, [Handle, ctypes.c_void_p]),
}


class EmbreeError(OctasplatError):
    """Embree refused a call; a fault of the installation or of memory, not of the data."""


@cache
def library() -> ctypes.CDLL:
    """The loaded Embree with argument types set.

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
    """Address of rtcIntersect1, passed to kernels at run time so that they can be cached on disk."""
    address = ctypes.cast(library().rtcIntersect1, ctypes.c_void_p).value
    assert address is not None
    return address


class Device:
    """An Embree device; ``threads`` = 0 lets it use every core for building."""

    def __init__(self, threads: int = 0) -> None:
        self._lib = library()
        self.handle = self._lib.rtcNewDevice(f"threads={threads}".encode())
        if not self.handle:
            raise EmbreeError(
                f"Embree could not start: {_ERROR_NAMES.get(self._lib.rtcGetDeviceError(None), '?')}"
            )

    def check(self, doing: str) -> None:
        """Raise if the last calls failed.

        Raises:
            EmbreeError: naming what was being done.
        """
        code = self._lib.rtcGetDeviceError(self.handle)
        if code:
            raise EmbreeError(f"Embree failed while {doing}: {_ERROR_NAMES.get(code, code)}")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._lib.rtcReleaseDevice(self.handle)


class BoxScene:
    """A bounding-volume hierarchy over boxes whose content a callback intersects.

    The callbacks' addresses and ``boxes_address`` (n rows of lower and upper corner, six float32) must
    stay valid for the life of the scene.
    """

    def __init__(
        self, device: Device, count: int, boxes_address: int, bounds: int, intersect: int, *, quality: int = 1
    ) -> None:
        lib = self._lib = device._lib
        self._device = device
        self.handle = lib.rtcNewScene(device.handle)
        lib.rtcSetSceneBuildQuality(self.handle, quality)
        geometry = lib.rtcNewGeometry(device.handle, _GEOMETRY_TYPE_USER)
        lib.rtcSetGeometryBuildQuality(geometry, quality)
        lib.rtcSetGeometryUserPrimitiveCount(geometry, count)
        lib.rtcSetGeometryUserData(geometry, boxes_address)
        lib.rtcSetGeometryBoundsFunction(geometry, bounds, None)
        lib.rtcSetGeometryIntersectFunction(geometry, intersect)
        lib.rtcCommitGeometry(geometry)
        lib.rtcAttachGeometry(self.handle, geometry)
        lib.rtcReleaseGeometry(geometry)
        lib.rtcCommitScene(self.handle)
        device.check(f"building the hierarchy over {count} Gaussians")

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self._lib.rtcReleaseScene(self.handle)
