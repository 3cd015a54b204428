"""Rays against meshes by Embree, with the same hits on every processor.

The package embreex builds a mesh from Python numbers, one coordinate at a time, which takes
longer than Embree's own work on it. Here Embree reads the arrays themselves. Faces are those of
embreex but where a ray passes along an edge; the tests compare them.

Embree's own distance and place on a face come from approximate reciprocals, whose last bits differ
between processors: captures that were rendered on an Intel and an AMD processor had other digests,
though of 100,000 values no more than one differed (`docs/simulation.md`).
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import types
from numba.experimental import function_type  # noqa: F401  (lets addresses pass as arguments)

from hwp_bench.base.errors import HwpError
from hwp_bench.base.kernels import compiled, cross, dot, helper

#: (u, v, distance), each (H,) float32: the place is (1 - u - v) a + u b + v c of the corners.
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


@compiled(nogil=True)
def places_on_faces(
    vertices: np.ndarray,
    faces: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    ray: np.ndarray,
    face: np.ndarray,
) -> Places:
    """Where each ray meets its face, in double precision; no place is outside the face.

    Source: Möller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997). Rays and
    vertices are rounded to single precision first, as Embree has them. A ray within the plane of
    its face meets it at the first corner.

    Args:
        vertices: (V, 3) float32 m.
        faces: (F, 3) vertex indices.
        origins: (N, 3) m, or (1, 3) for all.
        directions: (N, 3), any length; distances count in it.
        ray: (H,) which ray met something.
        face: (H,) the face that it met.
    """
    count = len(ray)
    u, v = np.empty(count, np.float32), np.empty(count, np.float32)
    distance = np.empty(count, np.float32)
    several = len(origins) > 1
    first, second, across, over = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    start, along = np.empty(3), np.empty(3)
    for i in range(count):
        a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
        origin = ray[i] if several else 0
        for k in range(3):
            corner = np.float64(vertices[a, k])
            first[k] = np.float64(vertices[b, k]) - corner
            second[k] = np.float64(vertices[c, k]) - corner
            start[k] = np.float64(np.float32(origins[origin, k])) - corner
            along[k] = np.float64(np.float32(directions[ray[i], k]))
        cross(along, second, across)
        cross(start, first, over)
        determinant = dot(first, across)
        s = t = 0.0
        if determinant != 0.0:
            s = max(dot(start, across) / determinant, 0.0)
            t = max(dot(along, over) / determinant, 0.0)
            outside = max(s + t, 1.0)
            s, t = s / outside, t / outside
        for k in range(3):
            start[k] = s * first[k] + t * second[k] - start[k]
        u[i], v[i], distance[i] = s, t, dot(start, along) / dot(along, along)
    return u, v, distance


# From the headers of Embree 4: rtcore_common.h, rtcore_buffer.h, rtcore_scene.h, rtcore_device.h.
_TRIANGLES, _INDEX_BUFFER, _VERTEX_BUFFER, _VERSION = 0, 0, 1, 0
_UINT3, _FLOAT3 = 0x5003, 0x9003
_ROBUST = 4
# Versions whose ray, in the order of its fields, is the one that `_cast` writes.
_VERSIONS = range(40000, 50000)
#: (ray, face, u, v, distance) of the rays that met something, each (H,).
Met = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class _Address(types.WrapperAddressProtocol):
    """A C function of three pointers, as compiled code is handed it."""

    def __init__(self, address: int) -> None:
        self._address = address

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return types.void(types.int64, types.int64, types.int64)


@dataclass(frozen=True, eq=False)
class Library:
    """Embree as this process has loaded it."""

    #: Calls a function of the C interface by its name, such as `rtcNewScene`.
    call: Callable[..., Any]
    #: The device, which builds on the thread that asks: processes share the cores already.
    device: int
    #: `rtcIntersect1` and `rtcOccluded1`.
    intersect: _Address
    occluded: _Address


@lru_cache(maxsize=1)
def library() -> Library | None:
    """Embree, loaded once, or None where its C interface is not the one that is known here."""
    from embreex import rtcore_scene

    pointer, number, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
    kinds: dict[str, tuple[Any, tuple[Any, ...]]] = {
        "rtcNewDevice": (pointer, (ctypes.c_char_p,)),
        "rtcGetDeviceProperty": (ctypes.c_ssize_t, (pointer, ctypes.c_int)),
        "rtcGetDeviceError": (ctypes.c_int, (pointer,)),
        "rtcNewScene": (pointer, (pointer,)),
        "rtcSetSceneFlags": (None, (pointer, ctypes.c_int)),
        "rtcCommitScene": (None, (pointer,)),
        "rtcReleaseScene": (None, (pointer,)),
        "rtcNewGeometry": (pointer, (pointer, ctypes.c_int)),
        "rtcSetSharedGeometryBuffer": (
            None,
            (pointer, ctypes.c_int, number, ctypes.c_int, pointer, size, size, size),
        ),
        "rtcCommitGeometry": (None, (pointer,)),
        "rtcAttachGeometry": (number, (pointer, pointer)),
        "rtcReleaseGeometry": (None, (pointer,)),
    }
    functions = {}
    try:
        # The extension is linked against Embree, so its handle finds Embree's symbols too.
        loaded = ctypes.CDLL(rtcore_scene.__file__)
        for name, (result, arguments) in kinds.items():
            functions[name] = getattr(loaded, name)
            functions[name].restype, functions[name].argtypes = result, arguments
        rays = [
            _Address(ctypes.cast(getattr(loaded, name), pointer).value or 0)
            for name in ("rtcIntersect1", "rtcOccluded1")
        ]
    except (OSError, AttributeError):
        return None

    def call(name: str, *arguments: Any) -> Any:
        return functions[name](*arguments)

    # Code for AVX-512 meets other faces along edges; every machine is to render the same pixels.
    device = call("rtcNewDevice", b"threads=1,max_isa=avx2")
    if not device or call("rtcGetDeviceProperty", device, _VERSION) not in _VERSIONS:
        return None
    return Library(call, device, *rays)


class EmbreeMesh:
    """One mesh, built where it is: vertices (V, 3) m and faces (F, 3)."""

    def __init__(self, loaded: Library, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._library, call = loaded, loaded.call
        # Embree reads 16 bytes at each vertex, so there is one more.
        self._vertices = np.zeros((len(vertices) + 1, 3), np.float32)
        self._vertices[:-1] = vertices
        self._faces = np.ascontiguousarray(faces, np.uint32)
        self._scene = call("rtcNewScene", loaded.device)
        weakref.finalize(self, call, "rtcReleaseScene", self._scene)
        # Rays that pass exactly between two faces must not fall through.
        call("rtcSetSceneFlags", self._scene, _ROBUST)
        self._geometry = call("rtcNewGeometry", loaded.device, _TRIANGLES)
        weakref.finalize(self, call, "rtcReleaseGeometry", self._geometry)
        for kind, layout, array, count in (
            (_VERTEX_BUFFER, _FLOAT3, self._vertices, len(vertices)),
            (_INDEX_BUFFER, _UINT3, self._faces, len(faces)),
        ):
            address = array.ctypes.data
            call(
                "rtcSetSharedGeometryBuffer", self._geometry, kind, 0, layout, address, 0, 12, count
            )
        call("rtcCommitGeometry", self._geometry)
        call("rtcAttachGeometry", self._scene, self._geometry)
        call("rtcCommitScene", self._scene)
        if error := call("rtcGetDeviceError", loaded.device):
            raise HwpError(f"Embree cannot build a mesh of {len(self._faces)} faces ({error})")

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> Met:
        """The first face on each ray.

        Args:
            origins: (N, 3) m, or (1, 3) for all.
            directions: (N, 3), any length.
        """
        rays = _rays(origins, directions)
        met = self._meet(*rays)
        ray = np.flatnonzero(met >= 0)
        face = met[ray].astype(np.int64)
        return ray, face, *places_on_faces(self._vertices, self._faces, *rays, ray, face)

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether anything is in each ray's way: (N,) bool; arguments as of `first_hits`."""
        return self._meet(*_rays(origins, directions), anything=True) >= 0

    def _meet(
        self, origins: np.ndarray, directions: np.ndarray, *, anything: bool = False
    ) -> np.ndarray:
        """(N,) the first face on each ray, or any number above -1; -1 where nothing is."""
        call = self._library.occluded if anything else self._library.intersect
        return _cast(call, self._scene, origins, directions)


def _rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(origins, np.float64), np.ascontiguousarray(directions, np.float64)


@helper
def _new_ray() -> np.ndarray:
    """A ray with room for its hit (RTCRayHit, 96 bytes), at a multiple of 64 bytes."""
    room = np.zeros(48, np.float32)
    start = (16 - (room.ctypes.data // 4) % 16) % 16
    return room[start : start + 32]


@helper
def _aim(ray: np.ndarray, numbers: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> None:
    """Write a ray: origin, near end, direction, time, far end, mask, id, flags; no hit yet."""
    ray[0], ray[1], ray[2], ray[3] = origin[0], origin[1], origin[2], 0.0
    ray[4], ray[5], ray[6], ray[7] = direction[0], direction[1], direction[2], 0.0
    ray[8] = 1e37
    numbers[9], numbers[10], numbers[11] = -1, 0, 0
    numbers[17], numbers[18], numbers[19], numbers[20] = -1, -1, -1, -1


@compiled(nogil=True)
def _cast(call: Any, scene: int, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """See `EmbreeMesh._meet`. Where it is only asked whether something is met, 0 stands for it."""
    ray = _new_ray()
    numbers = ray.view(np.int32)
    place = np.int64(ray.ctypes.data)
    met = np.empty(len(directions), np.int64)
    several = len(origins) > 1
    for i in range(len(directions)):
        _aim(ray, numbers, origins[i if several else 0], directions[i])
        call(scene, place, 0)
        # `rtcOccluded1` writes no face, but a negative end of the ray.
        met[i] = 0 if ray[8] < 0.0 else numbers[17]
    return met


def ray_mesh(vertices: np.ndarray, faces: np.ndarray) -> EmbreeMesh:
    """Make a mesh, vertices (V, 3) m and faces (F, 3), ready for queries of rays."""
    loaded = library()
    return EmbreexMesh(vertices, faces) if loaded is None else EmbreeMesh(loaded, vertices, faces)


class EmbreexMesh(EmbreeMesh):
    """The same through the package embreex alone: slower, the same hits."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._embreex = EmbreeScene()
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float32)
        self._faces = np.ascontiguousarray(faces, dtype=np.int32)
        self._mesh = TriangleMesh(self._embreex, self._vertices, self._faces)

    def _meet(
        self, origins: np.ndarray, directions: np.ndarray, *, anything: bool = False
    ) -> np.ndarray:
        if not len(directions):
            return np.zeros(0, dtype=np.int64)
        starts = np.broadcast_to(origins, directions.shape)
        rays = (np.ascontiguousarray(each, np.float32) for each in (starts, directions))
        query = "OCCLUDED" if anything else "INTERSECT"
        return np.asarray(self._embreex.run(*rays, query=query, output=False))
