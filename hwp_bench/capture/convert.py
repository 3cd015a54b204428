"""The hands of a capture in another form: of another hand model, or as meshes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.capture.folder import Capture, identify_hand_model, refuse_taken, rewrite_capture
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.hands.anchors import to_trimesh
from hwp_bench.hands.fitting import FitTargets, fit_hand
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.skinning import pose_hand, pose_parameters
from hwp_bench.hands.sources import load_template
from hwp_bench.hands.template import HandTemplate

#: Points of the source's skin that the target is fitted to.
SKIN_POINTS = 320


@dataclass(frozen=True)
class ConversionError:
    """The error of a conversion, over the valid frames of one hand."""

    #: Mean distance of the 21 landmarks, mm. Models put joints in different places in the flesh,
    #: so some of it is not an error.
    landmark_mm: float
    #: Mean distance of the source's skin from the target's, mm.
    skin_mm: float
    #: Largest of the frames' mean skin distances, mm.
    worst_skin_mm: float


def convert_hand(
    hand: HandParameters,
    source: HandTemplate,
    target: HandTemplate,
    betas: np.ndarray | None = None,
) -> tuple[HandParameters, ConversionError]:
    """Express a hand in another hand model, with the shape (10,) that is given, or a fitted one."""
    if source.side != target.side:
        raise UsageError(f"a {source.side} hand is not a {target.side} hand", field="target")
    posed = pose_parameters(source, hand)
    # Both wrists in the same place; the joints' axes agree between the models.
    unshaped = replace(hand, betas=np.zeros(10) if betas is None else betas)
    shift = (posed.joints[:, 0] - pose_parameters(target, unshaped).joints[:, 0]).numpy()
    start = replace(unshaped, transl=hand.transl + shift)
    step = max(1, len(source.vertices) // SKIN_POINTS)
    targets = FitTargets(posed.landmarks.numpy(), skin=posed.vertices[:, ::step].numpy())
    fitted = fit_hand(target, targets, start, keep_shape=betas is not None)
    return fitted.parameters, ConversionError(
        landmark_mm=float(np.nanmean(fitted.landmark_mm)),
        skin_mm=float(np.nanmean(fitted.skin_mm)),
        worst_skin_mm=float(np.nanmax(fitted.skin_mm)),
    )


def with_one_shape(
    template: HandTemplate,
    pose: np.ndarray,
    betas: np.ndarray,
    transl: np.ndarray,
    valid: np.ndarray,
) -> tuple[HandParameters, np.ndarray]:
    """Give all frames the median shape, and move each so that its vertices stay in place.

    The pose is the pose itself (no mean pose to be added); betas (F, 10) are one for each frame, as
    per-frame estimators give them. Returned too are (F,) the mean distances of the vertices from
    where the frame's own shape has them, mm; NaN where not valid.
    """
    if betas.shape != (len(pose), 10):
        raise ShapeMismatch(f"shape is {betas.shape}, expected ({len(pose)}, 10)", field="betas")
    common = np.median(betas[valid], axis=0) if valid.any() else np.zeros(10)
    clean = [
        np.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (pose, betas, transl)
    ]
    hand = HandParameters(clean[0], common, clean[2], valid)
    shared = pose_parameters(template, hand).vertices
    with torch.no_grad():
        tensors = template.to_torch(torch.float64)
        own = pose_hand(tensors, *map(torch.from_numpy, clean)).vertices
    shift = (own - shared).mean(dim=1)
    error = 1000.0 * (own - shared - shift[:, None]).norm(dim=-1).mean(dim=1).numpy()
    hand = replace(hand, transl=hand.transl + shift.numpy())
    return hand, np.where(valid, error, np.nan)


def convert_capture(
    capture: Capture, out: str | os.PathLike[str], source: str, *, overwrite: bool = False
) -> dict[str, ConversionError]:
    """Write a capture again with its hands in another hand model; images stay as they are.

    Returned are the errors of the capture. Those of its free-view clip stand in the clip.
    """
    refuse_taken(out, overwrite=overwrite)
    clip = capture.free_view
    info, hands, errors = _converted(capture, source)
    # An avatar has one shape, so that the clip has that of the capture.
    shapes = {side: hand.betas for side, hand in hands.items()}
    free_view = None if clip is None else (clip, *_converted(clip, source, shapes)[:2])
    rewrite_capture(capture, out, info, hands, free_view=free_view, overwrite=overwrite)
    return errors


def _converted(
    capture: Capture, source: str, shapes: Mapping[str, np.ndarray] | None = None
) -> tuple[CaptureInfo, dict[str, HandParameters], dict[str, ConversionError]]:
    """The description and the hands of a capture in another model; `shapes` are kept by side."""
    info = capture.info
    made, errors = {}, {}
    for side, hand in capture.hands.items():
        target, betas = load_template(source, side), None if shapes is None else shapes[side]
        made[side], errors[side] = convert_hand(hand, capture.template(side), target, betas)
    note = {side: vars(error) for side, error in errors.items()}
    changed = replace(
        info,
        hand_model=identify_hand_model(source, info.hands),
        source={**info.source, "converted": {"from": info.hand_model.name, "error": note}},
    )
    return changed, made, errors


#: Mesh formats by the ending of the file; of these only `.glb` keeps two hands apart by name.
FORMATS = (".glb", ".obj", ".ply", ".stl")


def hand_meshes(capture: Capture, frame: int, *, truth: bool = False) -> dict[str, trimesh.Trimesh]:
    """Return the posed meshes of the hands that one frame shows, by side, in the world, m."""
    capture.hand_poses(frame)  # Refuses a frame that is not there.
    hands = capture.hands
    if truth:
        known = capture.true_hands
        if known is None:
            raise UsageError(
                "does not know the true hand parameters",
                where=capture.root,
                remedy="Only simulated captures do; leave out --truth.",
            )
        hands = known  # It has the hand where the estimator failed, too.
    sides = [side for side, hand in hands.items() if hand.valid[frame]]
    if not sides:
        raise UsageError(f"shows no hand in frame {frame}", where=capture.root, field="--frame")
    return {
        side: to_trimesh(
            pose_parameters(capture.template(side), hands[side], [frame]).vertices[0],
            capture.template(side).faces,
        )
        for side in sides
    }


def write_meshes(meshes: dict[str, trimesh.Trimesh], path: str | os.PathLike[str]) -> Path:
    """Write meshes into one file, whose ending says the format."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise UsageError(
            f"ends in {path.suffix or 'nothing'!r}",
            where=path,
            remedy=f"Use one of {', '.join(FORMATS)}.",
        )
    kind = path.suffix.lower().removeprefix(".")
    scene = trimesh.Scene()
    for side, mesh in meshes.items():
        scene.add_geometry(mesh, geom_name=f"{side}_hand")
    whole = scene if kind == "glb" else scene.to_mesh()
    return atomic_write(path, whole.export(file_obj=None, file_type=kind))
