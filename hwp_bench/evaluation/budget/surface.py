"""Predicted frames next to their truth, and the posed surface that moves their pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from hwp_bench.capture import Capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, read_subject_mesh
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.hands.articulation import axis_angle_to_matrix, matrix_to_axis_angle
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.hands.skeleton import JOINT_COUNT, Camera, HandPose
from hwp_bench.hands.skinning import pose_hand, project
from hwp_bench.hands.template import HandTemplate, TemplateTensors
from hwp_bench.metrics.pixels import decibels, scored_pixels, squared_error
from hwp_bench.metrics.protocol import HWP_V1

# Numbers of each hand: the turn of every joint, then the translation.
_TURNS = 3 * JOINT_COUNT
_COUNT = _TURNS + 3
# Scale of an error in each of them, rad and m: estimators err by about 6 degrees and 1 cm.
_TURN, _SHIFT = 0.1, 0.01
# Step of the differences that give slopes, as a share of the scale: 1e-4 rad.
_STEP = 1e-3
# Edge of the cells of the surface, m; normals do not depend on it.
_PATCH = 0.004
#: Name of its row, and what it is.
NAME = "true colours"
TEXT = "the true frame moved to the given poses: an avatar without an error of its own"


@dataclass(frozen=True, eq=False)
class Pair:
    """A predicted frame and its truth; P pixels are scored."""

    #: (H, W, 3) float in [0, 1], sRGB over black.
    prediction: np.ndarray
    #: (H, W, 3) float in [0, 1], sRGB.
    target: np.ndarray
    #: (H, W) bool.
    region: np.ndarray
    #: (H, W, 3) unit normals of the posed hand in world axes; zeros where the hand is not drawn.
    normals: np.ndarray
    #: How the estimated hands' surface moves the pixels; None where no hand is known.
    surface: MovingSurface | None = None

    @property
    def error(self) -> float:
        """Mean squared error over the scored pixels."""
        return error_of(self.prediction, self)


def error_of(image: np.ndarray, pair: Pair) -> float:
    """Mean squared error of an image (H, W, 3) in place of the prediction."""
    return float(squared_error(image, pair.target)[pair.region].mean())


def pairs_of(
    capture: Capture, predictions: Path, frames: list[int]
) -> Iterator[tuple[int, Pair | None]]:
    """Read the predictions of some test frames next to their truth."""
    templates = {side: capture.template(side) for side in capture.info.sides}
    surfaces = HandSurfaces(templates, _PATCH)
    drawn = surfaces.footprints(
        capture.true_hands or capture.hands,
        capture.cameras.Ks,
        capture.cameras.viewmats,
        np.array(frames),
        capture.size,
    )
    for frame, footprint in zip(frames, drawn, strict=True):
        found = read_prediction(predictions, frame, capture.size)
        if found.pixels is None:
            yield frame, None
            continue
        mask, exact = capture.scoring_mask(frame)
        normals = np.zeros((*capture.size, 3))
        normals.reshape(-1, 3)[footprint.pixels] = footprint.normals
        shown = {
            side: hand.at(frame, side) for side, hand in capture.hands.items() if hand.valid[frame]
        }
        camera = capture.cameras.camera(frame, capture.info.width, capture.info.height)
        surface = MovingSurface(templates, shown, camera) if shown else None
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        yield (
            frame,
            Pair(found.pixels / 255.0, capture.frame(frame) / 255.0, region, normals, surface),
        )


# --- how the pixels of posed hands move when the pose changes


class MovingSurface:
    """The hands of one frame as they are estimated, and where other poses would put their pixels.

    A change has K numbers, 51 for each hand in the order of `hands`: a rotation vector for each
    of the 16 joints, rad, which turns the joint after its estimated rotation (in the axes of its
    parent), and the translation, m.
    """

    def __init__(
        self, templates: Mapping[str, HandTemplate], hands: Mapping[str, HandPose], camera: Camera
    ) -> None:
        self._camera, self._hands = camera, tuple(hands.values())
        self._tensors = [templates[side].to_torch(torch.float64) for side in hands]
        starts = np.cumsum([0, *(len(templates[side].vertices) for side in hands)])
        self._parts = [slice(*ends) for ends in pairwise(starts.tolist())]
        faces = [
            templates[side].faces + part.start
            for side, part in zip(hands, self._parts, strict=True)
        ]
        self._faces = np.concatenate(faces).astype(np.int64)
        #: (K,) scale of an error in each number: 0.1 rad, 0.01 m.
        self.scales = np.tile(np.repeat([_TURN, _SHIFT], [_TURNS, 3]), len(hands))
        self._places, _ = self._project(np.zeros(len(self.scales)))
        self._drawn_for: np.ndarray | None = None

    def sources(self, change: np.ndarray) -> np.ndarray:
        """Where the pixels of the changed hands lie in the image of the estimated ones.

        The changed surface is drawn, so that a finger that moves covers what is behind it. Pixels
        off the changed hands move as the nearest pixel on them: borders move with the hand.
        """
        self._draw(change)
        height, width = self._camera.height, self._camera.width
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        here = np.stack([columns, rows], axis=-1).astype(np.float64)
        if self._inside is None:
            return here.astype(np.float32)
        shown, mixed = self._inside
        from_place = mix_corners(self._places, self._faces, shown, mixed) - 0.5
        ways = from_place - here.reshape(-1, 2)[self._pixels]
        return (here + ways[self._nearest]).astype(np.float32)

    def moves(self, change: np.ndarray, region: np.ndarray) -> np.ndarray:
        """Derivatives of the surface's places at some pixels by each number, near a change."""
        self._draw(change)
        count = len(self.scales)
        if self._inside is None:
            return np.zeros((np.count_nonzero(region), 2, count))
        by_vertex = self._slopes(change).reshape(-1, 2 * count)
        wanted, back = np.unique(self._nearest[region], return_inverse=True)
        shown, mixed = (values[wanted] for values in self._inside)
        found = mix_corners(by_vertex, self._faces, shown, mixed)
        return found[back].reshape(-1, 2, count).astype(np.float64)

    def _draw(self, change: np.ndarray) -> None:
        if self._drawn_for is not None and np.array_equal(self._drawn_for, change):
            return
        places, depth = self._project(change)
        size = (self._camera.height, self._camera.width)
        face, mix = draw_faces(places, depth, self._faces, size)
        self._pixels = np.flatnonzero(face >= 0)
        self._inside = None
        if len(self._pixels):
            self._inside = face.reshape(-1)[self._pixels], mix.reshape(-1, 2)[self._pixels]
            rows, columns = distance_transform_edt(
                face < 0, return_distances=False, return_indices=True
            )
            # Number, among the pixels on the hands, of the one nearest to each pixel.
            self._nearest = np.searchsorted(self._pixels, rows * size[1] + columns)
        self._drawn_for = change.copy()

    def _project(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (V, 2) px and depths (V,) m of all vertices under a change (K,)."""
        found = [
            self._project_hand(hand, part[None])
            for hand, part in enumerate(np.split(change, len(self._hands)))
        ]
        places, depths = zip(*found, strict=True)
        return np.concatenate(places, axis=1)[0], np.concatenate(depths, axis=1)[0]

    def _slopes(self, change: np.ndarray) -> np.ndarray:
        """Derivative (V, 2, K) of the places of all vertices; a hand moves its own alone."""
        slopes = np.zeros((len(self._places), 2, len(change)))
        for hand, part in enumerate(self._parts):
            own = slice(_COUNT * hand, _COUNT * (hand + 1))
            steps = np.diag(_STEP * self.scales[own])
            ahead, _ = self._project_hand(hand, change[own] + np.vstack([steps, 0.0 * steps[:1]]))
            moved = (ahead[:-1] - ahead[-1]) / (_STEP * self.scales[own, None, None])
            slopes[part, :, own] = moved.transpose(1, 2, 0)
        return slopes

    def _project_hand(self, hand: int, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (B, V, 2) and depths (B, V) of one hand's vertices under B changes (B, 51)."""
        vertices = _posed(self._tensors[hand], self._hands[hand], changes)
        count = len(changes)
        viewmats = torch.as_tensor(self._camera.viewmat).double().expand(count, -1, -1)
        Ks = torch.as_tensor(self._camera.K).double().expand(count, -1, -1)
        places, depth = project(vertices, viewmats, Ks)
        return places.numpy(), depth.numpy()


def _posed(tensors: TemplateTensors, hand: HandPose, changes: np.ndarray) -> torch.Tensor:
    """Vertices (B, V, 3) of a hand under B changes (B, 51)."""
    given = torch.as_tensor(changes)
    turns = axis_angle_to_matrix(given[:, :_TURNS].reshape(-1, JOINT_COUNT, 3))
    pose = matrix_to_axis_angle(turns @ axis_angle_to_matrix(torch.as_tensor(hand.pose)))
    transl = torch.as_tensor(hand.transl) + given[:, _TURNS:]
    return pose_hand(tensors, pose, torch.as_tensor(hand.betas), transl).vertices


# --- the score of an avatar without an error of its own at the given poses


def surfaces_of(capture: Capture) -> dict[str, HandTemplate]:
    """The subject's own rest hands where the capture holds them, else the hand model."""
    own = capture.root / TRUE_TEMPLATE
    models = {side: capture.template(side) for side in capture.info.sides}
    if not own.is_file():
        return models
    return {side: read_subject_mesh(own, model) for side, model in models.items()}


def at_given_poses(
    capture: Capture, frame: int, templates: Mapping[str, HandTemplate]
) -> np.ndarray | None:
    """A true frame whose hands are moved from their true poses to the estimated ones.

    Each pixel of the moved surface takes its colour from where its point is in the true frame;
    pixels next to it follow the nearest one on it.
    """
    truth = capture.true_hands
    if truth is None or not all(hand.valid[frame] for hand in capture.hands.values()):
        return None
    true = {side: hand.at(frame, side) for side, hand in truth.items()}
    given = {side: capture.hands[side].at(frame, side) for side in true}
    camera = capture.cameras.camera(frame, capture.info.width, capture.info.height)
    change = []
    for side, hand in true.items():
        turn = Rotation.from_rotvec(given[side].pose) * Rotation.from_rotvec(hand.pose).inv()
        change += [turn.as_rotvec().ravel(), given[side].transl - hand.transl]
    sources = MovingSurface(templates, true, camera).sources(np.concatenate(change))
    image = capture.frame(frame).astype(np.float32) / 255.0
    moved: np.ndarray = cv2.remap(image, sources[..., 0], sources[..., 1], cv2.INTER_LINEAR)
    return moved


@dataclass(frozen=True, eq=False)
class Ceiling:
    """The score of an avatar without an error of its own, on a capture that knows the truth."""

    capture: Capture
    #: Rest hands of its subject, by side.
    templates: Mapping[str, HandTemplate]

    @classmethod
    def of(cls, capture: Capture) -> Ceiling | None:
        """The ceiling of a capture; None where it does not know the true poses."""
        return None if capture.true_hands is None else cls(capture, surfaces_of(capture))

    def psnr(self, frame: int, pair: Pair | None, score: float) -> float:
        """PSNR of `at_given_poses`, dB."""
        if pair is None:
            return score
        moved = at_given_poses(self.capture, frame, self.templates)
        return score if moved is None else decibels(error_of(moved, pair))
