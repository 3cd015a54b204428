"""How many training frames show each Gaussian's anchor."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.gaussians.training import TrainingClip

#: Cosine between normal and viewing direction from which a frame counts.
FACING = 0.1
# Frames that show skin, each by how much it counts.
_SHOWN = 0.1
# How far an anchor may lie behind the nearest one in its surroundings and still be seen, m: the
# surface is slanted there, and a finger is thicker.
_BEHIND = 0.006
# Cells of the depth image along the height of the frame.
_CELLS = 88
# Frames that are looked at together.
_CHUNK = 32
# Depth of nothing, m.
_FAR = 1e9


@torch.no_grad()
def shown_frames(
    rigs: Mapping[str, HandRig], clip: TrainingClip, visible: Callable[[Tensor], Tensor], count: int
) -> dict[str, Tensor]:
    """Count the training frames that show each anchor, each frame by how much it counts there.

    Args:
        visible: takes rows, (B,) int64 on the CPU, and returns how much each pixel of these frames
            shows the hand, (B, H, W) in [0, 1].

    Returns:
        (N,) by side, from 0 to R.
    """
    found = {side: torch.zeros(len(rig), device=clip.viewmats.device) for side, rig in rigs.items()}
    for rows in torch.arange(count).split(_CHUNK):
        says = visible(rows)
        here = rows.to(clip.viewmats.device)
        hands = {side: clip.hand(side, here) for side in rigs}
        shown = seen_anchors(hands, clip.viewmats[here], clip.Ks[here], says.shape[1:])
        for side, (pixels, facing) in shown.items():
            found[side] += (read_images(says, pixels) * (facing > 0.0)).sum(dim=0)
    return found


def never_shown(shown: Tensor, near: Tensor) -> Tensor:
    """(N,) bool, the Gaussians amid skin that no training frame shows.

    Skin is shown where the median of a place and its neighbours is a tenth of a frame or more: a
    single place may be taken for a shown one. Next to it Gaussians are free too, because they may
    have to reach beyond the hand model there.

    Args:
        shown: (N,) frames that show each.
        near: (N, K) int64, neighbours; -1: none.
    """

    def around(values: Tensor) -> Tensor:
        neighbours = torch.where(near >= 0, values[near.clamp(min=0)], torch.nan)
        return torch.cat([values[:, None], neighbours], dim=1)

    skin = around(shown).nanmedian(dim=1).values >= _SHOWN
    return around(skin.to(shown)).nan_to_num(0.0).amax(dim=1) < 0.5


@torch.no_grad()
def seen_anchors(
    hands: Mapping[str, AnchorPoses], viewmats: Tensor, Ks: Tensor, size: torch.Size
) -> dict[str, tuple[Tensor, Tensor]]:
    """Project anchors into B frames, and find those that neither hand hides.

    Args:
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) px.
        size: height and width of the frames, px.

    Returns:
        By side, (B, N, 2) px, and (B, N) cosine between normal and viewing direction, 0 where the
        anchor is not seen.
    """
    places = {side: _project(hand.positions, viewmats, Ks) for side, hand in hands.items()}
    nearest = _depth_image(places, size)
    found = {}
    for side, hand in hands.items():
        pixels, depth = places[side]
        facing = facing_of(hand, viewmats)
        seen = facing > FACING
        seen &= depth < read_images(nearest, pixels / _cell(size[0])) + _BEHIND
        found[side] = pixels, facing * seen
    return found


def _project(points: Tensor, viewmats: Tensor, Ks: Tensor) -> tuple[Tensor, Tensor]:
    """(B, N, 2) px and (B, N) depths of world points (B, N, 3); far away behind the camera."""
    inside = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = inside[..., 2]
    flat = inside @ Ks.mT
    pixels = flat[..., :2] / depth.clamp(min=1e-6)[..., None]
    return pixels, torch.where(depth > 1e-6, depth, _FAR)


def facing_of(hand: AnchorPoses, viewmats: Tensor) -> Tensor:
    """(B, N) cosine between the anchors' normals and the directions to the camera."""
    away = normalize(camera_centres(viewmats)[:, None] - hand.positions, dim=-1)
    return (away * quat_third_axis(hand.orientations)).sum(dim=-1)


def camera_centres(viewmats: Tensor) -> Tensor:
    """(B, 3) world places of the cameras of (B, 4, 4) world to camera."""
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def _cell(height: int) -> float:
    """Edge of a cell of the depth image, px."""
    return max(1.0, height / _CELLS)


def _depth_image(places: Mapping[str, tuple[Tensor, Tensor]], size: torch.Size) -> Tensor:
    """(B, h, w) depth of the nearest anchor of any hand in each cell and those around it."""
    cell = _cell(size[0])
    rows, columns = (int(edge / cell) + 1 for edge in size)
    frames = len(next(iter(places.values()))[1])
    device = next(iter(places.values()))[1].device
    image = torch.full((frames, rows * columns), _FAR, device=device)
    for pixels, depth in places.values():
        index, inside = _index(pixels / cell, rows, columns)
        image.scatter_reduce_(1, index, torch.where(inside, depth, _FAR), "amin")
    return -max_pool2d(-image.reshape(frames, 1, rows, columns), 3, 1, 1)[:, 0]


def read_images(images: Tensor, pixels: Tensor) -> Tensor:
    """(B, N) values of images (B, H, W) at (B, N, 2) places; 0 outside."""
    index, inside = _index(pixels, *images.shape[1:])
    return images.reshape(len(images), -1).gather(1, index) * inside


def _index(pixels: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Row-major numbers of the cells that places (B, N, 2) lie in, and whether they do."""
    x, y = pixels.nan_to_num(-1.0, -1.0, -1.0).clamp(-1.0, max(rows, columns)).floor().unbind(-1)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return torch.where(inside, y * columns + x, 0.0).long(), inside
