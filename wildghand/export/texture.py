"""The texture of an exported mesh: pictures of the avatar from all around, laid onto its skin."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy import ndimage

from hwp_bench.base.numerics import kd_tree
from hwp_bench.base.rays import ray_mesh
from hwp_bench.hands import HandTemplate, pose_hand, vertex_normals
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.export.splats import TURNS, middle, turned, view_turn

#: Texels along an edge.
SIZE = 1024
# How much of the pictures, which are as large as the texture, the hand's ball fills.
_FILLED = 0.95
# Power of the cosine between skin and viewer that a picture counts by, its least value, and how
# much more the front counts.
_POWER, _LEAST, _FRONT = 4.0, 0.15, 4.0
# Skin this far behind the first surface, m, is hidden; Gaussians stand that far off the mesh.
_HIDDEN = 0.003
# A pixel counts where the avatar covers this much of it.
_COVERED = 0.9
# Largest radius of the cap's place in the texture, in texels of 1024, and the space around it.
_CAP, _MARGIN = 24.0, 6.0


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """A texture, and the place in it of the cap that closes the wrist."""

    #: (S, S, 3) uint8 sRGB, row 0 at the top (v = 1).
    image: np.ndarray
    #: (2,) texture coordinates of the middle of the cap, origin at the bottom left.
    cap: np.ndarray
    #: Its radius in texture coordinates; 0 where the layout has no space for it.
    radius: float


def baked(
    avatar: WildGHandAvatar, side: str, layout: HandTemplate, size: int = SIZE
) -> SkinTexture:
    """Lay pictures of a hand at rest onto its skin.

    The hand turns in the studio as in the turntable. A picture counts where it shows the skin:
    facing the camera, nothing in front, covered by Gaussians. Skin that no picture shows takes the
    colour of the nearest skin that one shows; texels outside of the skin that of the nearest texel.
    """
    template = avatar.model.rigs[side].template
    faces = template.faces.cpu().numpy()
    rows, face, mix = skin_texels(layout, size)
    front = avatar.studio.posed()[side]
    centre = middle(avatar.pose({side: front}))
    vertices, _ = _posed(avatar, front)
    camera = _camera(vertices, centre, size)
    total, weight = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for turn, tilt in TURNS:
        hand = turned(avatar, {side: front}, view_turn(camera.viewmat, turn, tilt), centre)[side]
        rgba = avatar.render({side: hand}, camera)
        vertices, normals = _posed(avatar, hand)
        corners = faces[face]
        places = (vertices[corners] * mix[..., None]).sum(axis=1)
        shares = _shares(places, (normals[corners] * mix[..., None]).sum(axis=1))
        shares *= _FRONT if (turn, tilt) == TURNS[0] else 1.0
        looked = np.flatnonzero(shares > 0.0)
        looked = looked[_in_sight(vertices, faces, places[looked])]
        colors, covered = _read(rgba, camera, places[looked])
        shares = shares[looked] * (covered >= _COVERED)
        total[looked] += shares[:, None] * colors
        weight[looked] += shares
    rest, _ = _posed(avatar, front)
    places = (rest[faces[face]] * mix[..., None]).sum(axis=1)
    colors = _completed(places, total, weight)
    image = np.zeros((size * size, 3), dtype=np.float64)
    image[rows] = colors
    skin = np.zeros(size * size, dtype=bool)
    skin[rows] = True
    return _with_cap(avatar, front, image.reshape(size, size, 3), skin.reshape(size, size))


def skin_texels(layout: HandTemplate, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The texels whose middles lie on the skin.

    Returns:
        (M,) their numbers, row by row from the top; (M,) faces; (M, 3) barycentric coordinates.
    """
    flat = np.concatenate([layout.uv, np.zeros((len(layout.uv), 1))], axis=1)
    place = (np.arange(size) + 0.5) / size
    columns, rows = np.meshgrid(place, 1.0 - place)
    above = np.stack([columns.ravel(), rows.ravel(), np.ones(size * size)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (size * size, 1))
    ray, face, u, v, _ = ray_mesh(flat, layout.face_uv).first_hits(above, down)
    return ray, face, np.stack([1.0 - u - v, u, v], axis=1)


def _posed(avatar: WildGHandAvatar, hand: HandPose) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals of the mesh of a hand: (V, 3) each."""
    template = avatar.model.rigs[hand.side].template
    pose, betas, transl = (
        torch.as_tensor(np.asarray(each)[None]).to(template.vertices)
        for each in (hand.pose, hand.betas, hand.transl)
    )
    vertices = pose_hand(template, pose, betas, transl).vertices
    normals = vertex_normals(vertices, template.faces)
    return vertices[0].double().cpu().numpy(), normals[0].double().cpu().numpy()


def _camera(vertices: np.ndarray, centre: np.ndarray, size: int) -> Camera:
    """The studio's camera, with the ball around a hand in its square picture."""
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    half = 0.5 * size
    focal = _FILLED * half * np.sqrt(max(centre[2] ** 2 - radius**2, 1e-6)) / radius
    x, y = half - focal * centre[:2] / centre[2]
    K = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(4), size, size)


def _shares(places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(M,) how much a picture counts by the angle at which it shows the skin."""
    away = places / np.linalg.norm(places, axis=1, keepdims=True)
    length = np.linalg.norm(normals, axis=1).clip(min=1e-9)
    facing = -(away * normals).sum(axis=1) / length
    return np.where(facing > _LEAST, facing**_POWER, 0.0)


def _in_sight(vertices: np.ndarray, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(M,) whether nothing hides places of a mesh from the camera at the origin."""
    distance = np.linalg.norm(places, axis=1)
    ray, _, _, _, met = ray_mesh(vertices, faces).first_hits(
        np.zeros((1, 3)), places / distance[:, None]
    )
    found = np.full(len(places), np.inf)
    found[ray] = met
    return found > distance - _HIDDEN


def _read(rgba: np.ndarray, camera: Camera, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (M, 3) and coverage (M,) of a picture at places in front of its camera."""
    pixel = places @ camera.K.T
    # OpenCV counts from the middle of the first pixel.
    pixel = (pixel[:, :2] / pixel[:, 2:] - 0.5).astype(np.float32)
    read = np.zeros((0, 4), dtype=np.float32)
    if len(places):
        read = _sampled(rgba, pixel)
    covered = read[:, 3]
    return read[:, :3] / np.maximum(covered, 1e-6)[:, None], covered


def _sampled(rgba: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    # OpenCV takes no table with a side above 32,767.
    width = 1024
    padded = np.zeros((-(-len(pixel) // width) * width, 2), dtype=np.float32)
    padded[: len(pixel)] = pixel
    table = padded.reshape(-1, width, 2)
    across, down = (np.ascontiguousarray(table[..., axis]) for axis in range(2))
    read = cv2.remap(rgba, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(read.reshape(-1, 4)[: len(pixel)])


def _completed(places: np.ndarray, total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(M, 3) means of what pictures show; where none does, that of the nearest skin."""
    shown = weight > 1e-6
    colors = total / np.maximum(weight, 1e-6)[:, None]
    if shown.any() and not shown.all():
        _, nearest = kd_tree(places[shown]).query(places[~shown], k=1)
        colors[~shown] = colors[shown][nearest.reshape(-1)]
    return colors.clip(0.0, 1.0)


def _with_cap(
    avatar: WildGHandAvatar, front: HandPose, image: np.ndarray, skin: np.ndarray
) -> SkinTexture:
    """Fill what lies outside of the skin, and find a place for the cap of the wrist there."""
    size = len(image)
    away, nearest = ndimage.distance_transform_edt(~skin, return_indices=True)
    filled = image[tuple(nearest)]
    # The border of the picture ends the space, too.
    inside = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
    space = np.minimum(away, np.minimum(inside[:, None], inside[None]))
    row, column = np.unravel_index(int(space.argmax()), space.shape)
    margin = _MARGIN * size / SIZE
    radius = min(float(space[row, column]) - 2.0 * margin, _CAP * size / SIZE)
    middle_of_cap = np.array([(column + 0.5) / size, 1.0 - (row + 0.5) / size])
    wall = avatar.model.wall(front.side)
    if radius >= 1.0:
        closed = avatar.pose({front.side: front}, closed=True, viewmat=np.eye(4))
        # The discs of the wall come last and have one colour.
        color = closed.colors[-1] if wall is not None else np.median(closed.colors, axis=0)
        down, across = np.mgrid[:size, :size]
        disc = np.hypot(down - row, across - column) <= radius + margin
        filled[disc] = color.clip(0.0, 1.0)
    texels = np.rint(255.0 * filled).astype(np.uint8)
    return SkinTexture(texels, middle_of_cap, max(radius, 0.0) / size if radius >= 1.0 else 0.0)
