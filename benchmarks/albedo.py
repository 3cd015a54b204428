"""How much of the light is left in the colours of an avatar: learnt against true albedo.

Run from the repository: `python -m benchmarks.albedo -o sheet.jpg` fits simulated captures with and
without the light that casts shadows (`shadows`). A Gaussian's albedo is its learnt colour times the
network's own shadow coefficient, linear, mean over the frames that it faces. The error is the root
mean square of log albedo less the true one, less its median over the hand, smoothed over the
nearest Gaussians, for all of the hand and for the palm; the picture shows palms with the true
albedo and with both learnt ones, and what is too dark (blue) and too bright (red).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import wildghand
from benchmarks.turntable import camera_around
from hwp_bench.base.colors import linear_to_srgb, srgb_to_linear
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.base.numerics import kd_tree
from hwp_bench.base.tables import to_markdown
from hwp_bench.capture import Capture, open_capture
from hwp_bench.cli.options import named_table
from hwp_bench.hands.anchors import SurfaceAnchors
from hwp_bench.sim.geometry.surface import normal_operator, surface_normals, unit
from hwp_bench.sim.produce.capture import ensure_suite, suite
from hwp_bench.sim.subject.hand import of_side, painted, subject_hand
from hwp_bench.sim.subject.subject import Subject
from wildghand.avatar.avatar import WildGHandAvatar, over, splat
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.visibility.count import facing_of

#: Neighbours over which a place is smoothed: the light changes slowly, pores do not.
NEIGHBOURS = 12
#: Least cosine between normal and camera of a Gaussian that a frame shows, and the share of the
#: frames that must show it.
FACING, SEEN = 0.3, 0.1
#: Share of the back below which a place is of the palm.
PALM = 0.3
#: Frames that are looked at.
FRAMES = 24
# Edge of a picture, px; log error of the full colours.
_SIZE, _FULL = 220, 0.7


@dataclass(frozen=True, eq=False)
class Albedo:
    """Linear albedo of the N Gaussians of one hand."""

    #: (N, 3), learnt and true.
    learnt: np.ndarray
    true: np.ndarray
    #: (N,) bool: enough frames show it; it lies in the palm.
    seen: np.ndarray
    palm: np.ndarray
    #: (N,) log of learnt over true, less its median over what is seen, smoothed.
    error: np.ndarray

    def rms(self, where: np.ndarray) -> float:
        """Root mean square of the error of what is seen there."""
        return float(np.sqrt(np.mean(self.error[self.seen & where] ** 2)))


def true_albedo(
    subject: Subject, side: str, anchors: SurfaceAnchors
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Albedo (N, 3), share of the back of the hand (N,) and rest places (N, 3) m of anchors.

    Raises:
        SystemExit: the subject's triangles are not those of the hand model.
    """
    hand = subject_hand(subject, side)
    if hand.own_skin is not None or not np.array_equal(hand.template.faces, hand.model.faces):
        raise SystemExit(f"{subject.model}: is another mesh than the hand model's")
    faces, template = hand.template.faces, hand.template
    vertices = template.vertices + template.shape_basis @ hand.betas
    normals = surface_normals(vertices, faces, normal_operator(faces, len(vertices)))
    corners, mix = faces[np.asarray(anchors.face_index)], np.asarray(anchors.barycentric)
    points, ways, weights = (
        np.einsum("nk,nkc->nc", mix, values[corners])
        for values in (vertices, normals, template.weights)
    )
    anatomy = hand.anatomy(points, unit(ways), weights)
    return painted(anatomy, of_side(subject, side), fine=True).albedo, anatomy.back, points


@torch.no_grad()
def learnt_albedo(
    avatar: WildGHandAvatar, capture: Capture, side: str
) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (N, 3), linear, and the share of the frames (N,) that show each Gaussian."""
    model, count = avatar.model, len(avatar.model.rigs[side])
    shown, total = np.zeros((count, 1)), np.zeros((count, 3))
    frames = np.unique(np.linspace(0, len(capture) - 1, FRAMES).astype(int)).tolist()
    for frame in frames:
        pose, betas, transl = avatar.posed({side: capture.hand_poses(frame)[side]})[side]
        anchors = model.rigs[side].pose(pose, betas, transl)
        made = model.network(side, quat_third_axis(anchors.orientations), pose)
        viewmats = torch.as_tensor(capture.camera(frame).viewmat).float()[None]
        faces = (facing_of(anchors, viewmats)[0] > FACING).double().numpy()[:, None]
        colors = model.network.activation(made.raw).colors * made.shadow
        colors = colors[0].double().numpy()
        shown, total = shown + faces, total + faces * srgb_to_linear(colors.clip(0.0, 1.0))
    return total / np.maximum(shown, 1.0), (shown / len(frames))[:, 0]


def compare_albedo(
    avatar: WildGHandAvatar, capture: Capture, subject: Subject, side: str
) -> Albedo:
    """Compare one hand of an avatar with the person whom its capture shows."""
    true, back, places = true_albedo(subject, side, avatar.model.rigs[side].anchors)
    learnt, share = learnt_albedo(avatar, capture, side)
    seen = share >= SEEN
    ratio = np.log(np.maximum(learnt, 1e-3) / np.maximum(true, 1e-3)).mean(axis=1)
    near = kd_tree(places[seen]).query(places, k=NEIGHBOURS)[1]
    smooth = ratio[seen][near].mean(axis=1)
    return Albedo(learnt, true, seen, back < PALM, smooth - np.median(smooth[seen]))


def pictures(avatar: WildGHandAvatar, side: str, found: Albedo) -> list[np.ndarray]:
    """The palm at rest in true albedo, in learnt albedo, and its error: (H, W, 3) uint8 each."""
    hand = avatar.pose({side: avatar.rest_poses()[side]})
    means = hand.means.astype(float)
    up, _, back = np.linalg.svd(means - means.mean(axis=0), full_matrices=False)[2]
    # The palm looks to where most of its anchors lie.
    palm = means[found.palm].mean(axis=0) - means[~found.palm].mean(axis=0)
    camera = camera_around(means, up, back * np.sign(back @ palm), _SIZE)
    gain = np.exp(
        np.median(np.log(np.maximum(found.true, 1e-3)[found.seen]))
        - np.median(np.log(np.maximum(found.learnt, 1e-3)[found.seen]))
    )
    shares = np.clip(np.where(found.seen, found.error, 0.0) / _FULL, -1.0, 1.0)[:, None]
    hot, cold = np.array([0.8, 0.1, 0.1]), np.array([0.1, 0.2, 0.9])
    tinted = 0.9 + np.where(shares > 0, shares * (hot - 0.9), -shares * (cold - 0.9))
    drawn = []
    for colors in (linear_to_srgb(found.true), linear_to_srgb(gain * found.learnt), tinted):
        rgba = splat(replace(hand, colors=colors.clip(0.0, 1.0).astype(np.float32)), camera)
        drawn.append(over(rgba, (255, 255, 255)))
    return drawn


def main() -> None:
    """Fit, compare, print the table and draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="wild-dev")
    parser.add_argument("--captures", nargs="+", help="their names (default: all)")
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--gaussians", type=int, default=5000)
    parser.add_argument("-o", "--out", type=Path, required=True, help="picture to write")
    given = parser.parse_args()
    items = [one for one in suite(given.suite) if not given.captures or one.id in given.captures]
    rows: list[list[str | float]] = []
    tiles: list[np.ndarray] = []
    for item, folder in zip(items, ensure_suite(items), strict=True):
        capture, found = open_capture(folder), {}
        for shadows in (True, False):
            settings = {"gaussians": given.gaussians, "shadows.enabled": shadows}
            with tempfile.TemporaryDirectory() as out:
                avatar = wildghand.fit(
                    capture, Path(out) / "avatar", steps=given.steps, settings=settings
                )
                side = avatar.sides[0]
                found[shadows] = compare_albedo(avatar, capture, item.scene.subject, side)
                drawn = pictures(avatar, side, found[shadows])
            if shadows:
                tiles.append(labelled(drawn[0], f"{item.id}: true albedo"))
            for picture, name in zip(drawn[1:], ("learnt", "error"), strict=True):
                tiles.append(labelled(picture, f"{name}, {'with' if shadows else 'without'}"))
        row: list[str | float] = [f"{item.id}, {side} hand"]
        for where in (np.ones_like(found[True].palm), found[True].palm):
            row += [found[False].rms(where), found[True].rms(where)]
        rows.append(row)
    names = "capture, all without shadows, all with, palm without, palm with"
    print(to_markdown(named_table("RMS error of log albedo", names, rows)))
    write_image(given.out, sheet(tiles, 5))


if __name__ == "__main__":
    main()
