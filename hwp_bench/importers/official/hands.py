"""From the tracker's hands to the capture's: MANO as it is, or the free hand by fitting.

The tracker poses the *right* MANO hand with the left hand's parameters, centres it on its middle
knuckle, negates x, and adds `root_rel` and the translation. The left parameters are therefore
those of a mirrored right hand: a rotation vector (x, y, z) becomes (x, -y, -z) in the left hand's
own frame. The translation is taken from the stored vertices in closed form, so that no convention
about the centre is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.hands import HandParameters, HandTemplate, load_template, pose_hand
from hwp_bench.hands.fitting import FitTargets, FittingSettings, fit_hand
from hwp_bench.hands.sources import FINGERTIPS
from hwp_bench.importers.official.release_records import OfficialRecords, SideRecords

#: Stored vertices that MANO misses by more than this (median frame, mm) mean that the file does
#: not follow the convention that is assumed, or was made with another hand model.
MAX_VERTEX_MM = 10.0
#: Rows of the 21 landmarks that are vertices: the finger tips.
_TIP_ROWS = [4, 8, 12, 16, 20]


@dataclass(frozen=True, eq=False)
class ImportedHand:
    """One hand in the capture's convention.

    Attributes:
        hand: its parameters.
        error_mm: (F,) mean distance from the tracker's vertices, mm; NaN where not valid.
    """

    hand: HandParameters
    error_mm: np.ndarray


def import_hands(
    records: OfficialRecords,
    sides: tuple[str, ...],
    centres: np.ndarray,
    model: str,
    *,
    compat: bool,
    where: str,
) -> dict[str, ImportedHand]:
    """Take the hands of a capture over, by side.

    Args:
        records: of the capture.
        sides: the hands that the capture has.
        centres: (F, 2) px, half the frames' sizes.
        model: the hand model, as `load_template` takes it: MANO is taken over, the free hand
            is fitted.
        compat: use the translations that the released loader uses.
        where: the folder, for messages.
    """
    mean = load_template(model, "right").mean_pose
    made = {}
    for side in sides:
        hand = _swapped(records, side) if compat else records.sides[side]
        template = load_template(model, side)
        if model.startswith("mano:"):
            made[side] = mano_hand(hand, template, mean, where=where)
        else:
            knuckle = hand.camera + (records.root_rel if side == "left" else 0.0)
            made[side] = free_hand(hand, template, records.focal, centres, knuckle)
    return made


def own_rotations(pose: np.ndarray, side: str) -> np.ndarray:
    """Rotation vectors of a hand in its own frame, from the tracker's.

    Args:
        pose: (F, 16, 3) axis-angle rad; a left hand's are those of a mirrored right hand.
        side: `right` or `left`.
    """
    return pose if side == "right" else pose * np.array([1.0, -1.0, -1.0])


def mano_hand(
    records: SideRecords, template: HandTemplate, right_mean: np.ndarray, *, where: str
) -> ImportedHand:
    """Take MANO's parameters over; one shape (the median) for the clip.

    Args:
        records: the tracker's hand.
        template: MANO of its side.
        right_mean: (45,) mean pose of the right MANO hand, which the tracker poses.
        where: the folder, for the message.

    Raises:
        BadInput: the posed hand is not where the stored vertices are.
    """
    valid = records.valid
    pose = np.where(valid[:, None, None], records.pose, 0.0)
    pose[:, 1:] += right_mean.reshape(15, 3)
    pose = own_rotations(pose, template.side)
    betas = np.median(records.shape[valid], axis=0)
    with torch.no_grad():
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(pose),
            torch.from_numpy(betas),
            torch.zeros(len(pose), 3, dtype=torch.float64),
        )
    gap = records.vertices - posed.vertices.numpy()
    transl = gap.mean(axis=1)
    error = 1000.0 * np.linalg.norm(gap - transl[:, None], axis=-1).mean(axis=1)
    median = float(np.median(error[valid]))
    if median > MAX_VERTEX_MM:
        raise BadInput(
            f"the {template.side} MANO hand misses the stored vertices by {median:.1f} mm in the "
            f"median frame, more than {MAX_VERTEX_MM:g}",
            where=where,
            field=f"verts3d_world_{template.side}",
            remedy="Is --mano the MANO of mano_v1_2? Otherwise this file follows another "
            "convention than the release; import it without --mano.",
        )
    return ImportedHand(HandParameters(pose, betas, transl, valid), np.where(valid, error, np.nan))


def free_hand(
    records: SideRecords,
    template: HandTemplate,
    focal: np.ndarray,
    centres: np.ndarray,
    knuckle: np.ndarray,
    settings: FittingSettings | None = None,
) -> ImportedHand:
    """Fit the free hand to the tracker's vertices and joints; MANO itself is not needed.

    Args:
        records: the tracker's hand.
        template: the free hand of its side.
        focal: (F,) px of the whole frame.
        centres: (F, 2) px, half the frames' sizes.
        knuckle: (F, 3) m, where the middle knuckle is.
        settings: steps and weights of the fit.
    """
    valid = records.valid
    landmarks = np.full((len(valid), 21, 3), np.nan)
    landmarks[:, _TIP_ROWS] = records.vertices[:, list(FINGERTIPS)]
    landmarks[:, 9] = knuckle
    offsets = (records.landmarks - centres[:, None]) / focal[:, None, None]
    rays = np.concatenate([offsets, np.ones((*offsets.shape[:2], 1))], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    pose = own_rotations(np.where(valid[:, None, None], records.pose, 0.0), template.side)
    zeros = torch.zeros(len(pose), 3, dtype=torch.float64)
    with torch.no_grad():
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(pose),
            torch.zeros(10, dtype=torch.float64),
            zeros,
        )
    transl = np.where(valid[:, None], knuckle - posed.landmarks[:, 9].numpy(), 0.0)
    start = HandParameters(pose, np.zeros(10), transl, valid)
    targets = FitTargets(landmarks, rays, records.vertices[:, ::2])
    fitted = fit_hand(template, targets, start, settings)
    return ImportedHand(fitted.parameters, fitted.skin_mm)


def _swapped(records: OfficialRecords, side: str) -> SideRecords:
    """A hand with the other one's translation, as the released loader hands it to its network.

    The loader lists pose and shape as (right, left) and the translations as (left, right). Where
    the tracker gives both hands one translation, which it mostly does, nothing changes.
    """
    own = records.sides[side]
    other = records.sides.get("left" if side == "right" else "right")
    if other is None:
        return own
    moved = own.vertices - own.camera[:, None] + other.camera[:, None]
    return replace(own, vertices=moved, camera=other.camera, valid=own.valid & other.valid)
