"""Hands drawn into frames. Oracles: trimesh's normals, the posed mesh, known motions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
import trimesh

from hwp_bench.hands import HandParameters, HandTemplate, pose_hand
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from hwp_bench.hands.raster import draw_silhouette

SIZE, FRAMES = 96, 3
K = np.array([[1.4 * SIZE, 0.0, SIZE / 2], [0.0, 1.4 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
# Across the image from frame to frame, m, at this depth, m.
STEP, DEPTH = 0.01, 0.45


def moving(side: str = "right") -> HandParameters:
    """A hand upright before the camera that bends a little and moves to the right."""
    pose = np.random.default_rng(3).normal(0.0, 0.08, (1, 16, 3)).repeat(FRAMES, axis=0)
    pose[:, 0] = [np.pi / 2, 0.0, 0.0]
    towards = 0.09 if side == "right" else -0.09
    transl = np.stack(
        [towards + STEP * np.arange(FRAMES), np.zeros(FRAMES), np.full(FRAMES, DEPTH)], axis=1
    )
    return HandParameters(
        pose=pose, betas=np.zeros(10), transl=transl, valid=np.ones(FRAMES, dtype=bool)
    )


def drawn(
    templates: Mapping[str, HandTemplate], hands: Mapping[str, HandParameters]
) -> list[Footprint]:
    surfaces = HandSurfaces(templates, 0.004)
    views = np.eye(4)[None].repeat(FRAMES, axis=0)
    Ks = K[None].repeat(FRAMES, axis=0)
    return list(surfaces.footprints(hands, Ks, views, np.arange(FRAMES), (SIZE, SIZE)))


def posed(template: HandTemplate, hand: HandParameters, frame: int) -> trimesh.Trimesh:
    tensors = template.to_torch()
    vertices = pose_hand(
        tensors,
        torch.as_tensor(hand.pose[frame : frame + 1], dtype=torch.float32),
        torch.as_tensor(hand.betas, dtype=torch.float32),
        torch.as_tensor(hand.transl[frame : frame + 1], dtype=torch.float32),
    ).vertices[0]
    return trimesh.Trimesh(vertices.numpy(), template.faces, process=False)


def test_the_silhouette_is_that_of_the_posed_mesh(free_right: HandTemplate) -> None:
    hand = moving()
    for frame, footprint in enumerate(drawn({"right": free_right}, {"right": hand})):
        vertices = posed(free_right, hand, frame).vertices
        pixels = vertices[:, :2] / vertices[:, 2:] * K[0, 0] + SIZE / 2
        expected = draw_silhouette(pixels, free_right.faces, SIZE) > 0
        np.testing.assert_array_equal(footprint.silhouette, expected)
        np.testing.assert_array_equal(footprint.pixels, np.flatnonzero(expected))


def test_normals_are_unit_and_as_trimesh_has_them(free_right: HandTemplate) -> None:
    hand = moving()
    footprint = drawn({"right": free_right}, {"right": hand})[0]
    mesh = posed(free_right, hand, 0)
    np.testing.assert_allclose(np.linalg.norm(footprint.normals, axis=1), 1.0, atol=1e-4)
    # Where the mesh's normals lie on average, and towards the camera almost everywhere.
    rays = np.stack(
        [footprint.pixels % SIZE + 0.5 - SIZE / 2, footprint.pixels // SIZE + 0.5 - SIZE / 2],
        axis=1,
    )
    ways = np.column_stack([rays / K[0, 0], np.ones(len(rays))])
    places, index_ray, faces = mesh.ray.intersects_location(
        np.zeros_like(ways), ways, multiple_hits=False
    )
    assert len(places) > 0.98 * len(ways)
    agree = np.einsum("pi,pi->p", footprint.normals[index_ray], mesh.face_normals[faces])
    assert np.quantile(agree, 0.02) > 0.8
    assert np.median(agree) > 0.99
    assert np.mean(footprint.facing > 0.0) > 0.97


def test_motion_is_that_of_the_image(free_right: HandTemplate) -> None:
    found = [print_.motion for print_ in drawn({"right": free_right}, {"right": moving()})]
    assert found[0] == 0.0
    assert found[1:] == pytest.approx([STEP / DEPTH * K[0, 0]] * 2, rel=0.08)


def test_a_place_keeps_its_cell_and_hands_share_none(
    free_right: HandTemplate, free_left: HandTemplate
) -> None:
    hands = {"right": moving(), "left": moving("left")}
    templates = {"right": free_right, "left": free_left}
    alone = {side: drawn({side: templates[side]}, {side: hands[side]}) for side in hands}
    first, second = alone["right"][0], alone["right"][1]
    shared = np.intersect1d(first.cells, second.cells)
    assert len(shared) > 0.6 * len(np.unique(first.cells))
    both = drawn(templates, hands)[0]
    only_right = both.cells[
        np.isin(both.pixels, np.setdiff1d(first.pixels, alone["left"][0].pixels))
    ]
    only_left = both.cells[
        np.isin(both.pixels, np.setdiff1d(alone["left"][0].pixels, first.pixels))
    ]
    assert len(only_right) > 100
    assert len(only_left) > 100
    assert not np.isin(only_right, only_left).any()
