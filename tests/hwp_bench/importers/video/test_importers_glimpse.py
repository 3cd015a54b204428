"""A look at hands that are still fitted. Oracle: the one colour that their pictures have."""

from __future__ import annotations

import numpy as np
from painted_clip import footage

from hwp_bench.hands.raster import draw_faces
from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.video.glimpse import paint_hand
from hwp_bench.importers.video.masks import ProjectedClip


def test_a_hand_before_black_gets_its_colour_and_nothing_of_the_black() -> None:
    clip, windows, *_ = footage()
    faces, count, edge = clip.template.faces, len(clip.vertices), windows.size
    joints = clip.vertex_pixels[:, :21]
    projected = ProjectedClip(
        *(clip.vertices, clip.vertex_pixels, joints, faces, np.ones(count, bool)),
        *(joints[..., 0], boundary_vertices(faces), windows),
    )
    images = np.zeros((count, edge, edge, 3), np.uint8)
    for frame in range(count):
        pixels, depth = projected.in_crop(frame, edge), clip.vertices[frame, :, 2]
        images[frame][draw_faces(pixels, depth, faces, (edge, edge))[0] >= 0] = (200, 120, 90)
    detected = np.arange(count) != 3
    images[3] = 255
    hand = paint_hand(projected, images, detected)
    np.testing.assert_array_equal(hand.colors, np.tile([200, 120, 90], (len(hand.vertices), 1)))
    assert any(np.array_equal(hand.vertices, seen) for seen in clip.vertices[detected])
