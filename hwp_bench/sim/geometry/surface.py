"""Surfaces and materials: everything that a ray can hit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a surface; textures have row 0 at the top (v = 1)."""

    #: (H, W, 3) float32, linear reflectance.
    albedo: np.ndarray
    #: (H, W) float32 in 0-1, or None for `gloss` everywhere.
    roughness: np.ndarray | None = None
    #: Roughness of a material without a map.
    gloss: float = 0.6
    #: Reflectance at normal incidence.
    specular: float = 0.04
    #: (H, W) float32 m, or None for a smooth surface.
    height: np.ndarray | None = None
    #: Light that wraps around the terminator inside the material, per linear channel.
    wrap: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: Share of the albedo that the surface emits itself, such as a screen.
    glow: float = 0.0


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh with materials, in world metres."""

    #: (V, 3).
    vertices: np.ndarray
    #: (V, 3) unit normals.
    normals: np.ndarray
    #: (F, 3).
    faces: np.ndarray
    #: (F, 3, 2) texture coordinates of the corners.
    corner_uv: np.ndarray
    #: (F,) index into `materials`.
    material: np.ndarray
    #: What the faces are made of.
    materials: tuple[Material, ...]
    #: (F,) 1 where the face is hand, 0 elsewhere (sleeve, object).
    hand: np.ndarray
    #: (V,) share of the sky that each vertex sees, or None until known.
    openness: np.ndarray | None = None


def join(surfaces: list[Surface]) -> Surface:
    """Put surfaces together into one."""
    if len(surfaces) == 1:
        return surfaces[0]
    starts = np.cumsum([0, *(len(part.vertices) for part in surfaces)])
    first = np.cumsum([0, *(len(part.materials) for part in surfaces)])
    pairs = list(zip(surfaces, starts, first, strict=False))
    return Surface(
        vertices=np.concatenate([part.vertices for part in surfaces]),
        normals=np.concatenate([part.normals for part in surfaces]),
        faces=np.concatenate([part.faces + start for part, start, _ in pairs]),
        corner_uv=np.concatenate([part.corner_uv for part in surfaces]),
        material=np.concatenate([part.material + start for part, _, start in pairs]),
        materials=tuple(material for part in surfaces for material in part.materials),
        hand=np.concatenate([part.hand for part in surfaces]),
    )


def transformed(surface: Surface, transform: np.ndarray) -> Surface:
    """Move a surface by a (4, 4) rigid motion with uniform scale."""
    linear = transform[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    return replace(
        surface,
        vertices=surface.vertices @ linear.T + transform[:3, 3],
        normals=surface.normals @ (linear.T / scale),
    )


def plain(color: tuple[float, float, float] | np.ndarray, **settings: float) -> Material:
    """A material of one linear colour."""
    albedo = np.asarray(color, dtype=np.float32).reshape(1, 1, 3)
    return Material(albedo=albedo, **settings)  # type: ignore[arg-type]
