"""The skin of a subject as textures, painted once and kept in the cache."""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import atomic_write, cache_root, sha256_json
from hwp_bench.sim.geometry.rays import Tracer
from hwp_bench.sim.geometry.surface import unit
from hwp_bench.sim.subject.hand import SubjectHand, subject_hand
from hwp_bench.sim.subject.skin import painted
from hwp_bench.sim.subject.subject import Subject

#: Edge of the skin atlas in texels; about 0.25 mm of skin each.
ATLAS = 1024
#: Version of the skin painting; part of the cache key.
SKIN_VERSION = 3
#: Version of what looks add to it; part of the key where a subject has looks.
LOOKS_VERSION = 1


@dataclass(frozen=True, eq=False)
class SkinAtlas:
    """Skin of one subject as textures, row 0 at the top (v = 1)."""

    #: (ATLAS, ATLAS, 3) float32, linear reflectance.
    albedo: np.ndarray
    #: (ATLAS, ATLAS) float32, m.
    height: np.ndarray
    #: (ATLAS, ATLAS) float32, 0-1.
    roughness: np.ndarray


@lru_cache(maxsize=2)
def skin_atlas(subject: Subject) -> SkinAtlas:
    """Paint a subject's skin, or read it from the cache. Both hands share it, mirrored."""
    hand = subject_hand(subject, "right")
    return kept(hand, subject, "", lambda: painted_atlas(hand, subject, ATLAS))


def kept(
    hand: SubjectHand, subject: Subject, part: str, paint: Callable[[], SkinAtlas]
) -> SkinAtlas:
    """Read a painting from the cache, or paint it and keep it where the cache can be written."""
    person: list[Any] = [subject.seed, subject.tone, subject.age]
    looks = replace(subject.looks, rings=(), wrist=()).to_json()
    if looks:
        person.append([LOOKS_VERSION, looks])
    if part:
        person.append(part)
    if hand.template is not hand.model:
        # A template's digest is of its shape; other subjects may lay out the same shape otherwise.
        person.append(hashlib.sha256(np.round(hand.corner_uv, 6).tobytes()).hexdigest())
    key = sha256_json([SKIN_VERSION, ATLAS, hand.template.digest, hand.betas.tolist(), person])
    path = cache_root() / "sim" / "skin" / f"{key}.npz"
    if path.exists():
        try:
            arrays = read_npz(path)
            return SkinAtlas(*(arrays[name] for name in ("albedo", "height", "roughness")))
        except (BadInput, KeyError):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    atlas = paint()
    # Where the cache cannot be written, it is painted again next time.
    with contextlib.suppress(HwpError):
        buffer = io.BytesIO()
        np.savez(buffer, albedo=atlas.albedo, height=atlas.height, roughness=atlas.roughness)
        atomic_write(path, buffer.getvalue())
    return atlas


def painted_atlas(hand: SubjectHand, subject: Subject, edge: int) -> SkinAtlas:
    """Paint the skin of a hand; nothing is kept."""
    from scipy.ndimage import distance_transform_edt

    flat = np.concatenate([hand.corner_uv, np.zeros((*hand.corner_uv.shape[:2], 1))], axis=2)
    tracer = Tracer(flat.reshape(-1, 3), np.arange(flat.shape[0] * 3).reshape(-1, 3), Counter())
    ticks = (np.arange(edge) + 0.5) / edge
    u, v = np.meshgrid(ticks, 1.0 - ticks)
    origins = np.stack([u.ravel(), v.ravel(), np.ones(edge * edge)], axis=1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
    hits = tracer.first_hits(origins, down, "atlas")
    corners = hand.faces[hits.face]

    def spread(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", hits.weights, values[corners])

    weights = spread(hand.lift @ hand.template.weights)
    anatomy = hand.anatomy(spread(hand.rest), unit(spread(hand.rest_normals)), weights)
    skin = painted(anatomy, subject, fine=True)
    layers = np.zeros((edge * edge, 5), dtype=np.float32)
    layers[hits.ray] = np.column_stack([skin.albedo, skin.height, skin.roughness])
    empty = np.ones(edge * edge, dtype=bool)
    empty[hits.ray] = False
    # Texels outside the atlas's islands repeat the nearest one inside, so that no seam shows.
    nearest = distance_transform_edt(
        empty.reshape(edge, edge), return_distances=False, return_indices=True
    )
    layers = layers.reshape(edge, edge, 5)[nearest[0], nearest[1]]
    return SkinAtlas(
        np.ascontiguousarray(layers[..., :3]),
        np.ascontiguousarray(layers[..., 3]),
        np.ascontiguousarray(layers[..., 4]),
    )
