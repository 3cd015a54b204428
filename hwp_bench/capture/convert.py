"""The hands of a capture in another form: of another hand model, or as meshes."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.capture.reader import Capture, identify_hand_model
from hwp_bench.capture.writer import rewrite_capture
from hwp_bench.hands.anchors import to_trimesh
from hwp_bench.hands.fitting import FitTargets, FittedHand, FittingSettings, fit_hand
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.skinning import pose_hand
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
    settings: FittingSettings | None = None,
) -> tuple[HandParameters, ConversionError]:
    """Express a hand in another hand model.

    Args:
        hand: parameters that belong to `source`.
        source: the hand model that they are given in.
        target: the hand model to convert to, of the same side.
        settings: steps and weights of the fit.

    Returns:
        Parameters that belong to `target`, and how far they are from the source's hand.

    Raises:
        UsageError: the templates are of different sides.
        BadInput: no frame is valid.
    """
    if source.side != target.side:
        raise UsageError(f"a {source.side} hand is not a {target.side} hand", field="target")
    tensors = source.to_torch(torch.float64)
    with torch.no_grad():
        posed = pose_hand(tensors, *_tensors(hand))
    # Both wrists in the same place; the joints' axes agree between the models.
    with torch.no_grad():
        other = pose_hand(target.to_torch(torch.float64), *_tensors(_unshaped(hand)))
    shift = (posed.joints[:, 0] - other.joints[:, 0]).numpy()
    start = replace(_unshaped(hand), transl=hand.transl + shift)
    step = max(1, len(source.vertices) // SKIN_POINTS)
    targets = FitTargets(posed.landmarks.numpy(), skin=posed.vertices[:, ::step].numpy())
    fitted = fit_hand(target, targets, start, settings)
    return fitted.parameters, conversion_error(fitted)


def conversion_error(fitted: FittedHand) -> ConversionError:
    """Average a fit's errors over the valid frames."""
    return ConversionError(
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

    Args:
        template: the hand model.
        pose: (F, 16, 3) axis-angle rad, the pose itself (no mean pose to be added).
        betas: (F, 10), one for each frame, as per-frame estimators give them.
        transl: (F, 3) m.
        valid: (F,) bool.

    Returns:
        Parameters with one shape, and (F,) the mean distance of the vertices from where the
        frame's own shape has them, mm; NaN where not valid.

    Raises:
        ShapeMismatch: the arrays do not describe the same frames.
    """
    if betas.shape != (len(pose), 10):
        raise ShapeMismatch(f"shape is {betas.shape}, expected ({len(pose)}, 10)", field="betas")
    common = np.median(betas[valid], axis=0) if valid.any() else np.zeros(10)
    clean = [
        np.where(valid.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in (pose, betas, transl)
    ]
    tensors = template.to_torch(torch.float64)
    with torch.no_grad():
        own = pose_hand(tensors, *map(torch.from_numpy, clean)).vertices
        shared = pose_hand(
            tensors,
            torch.from_numpy(clean[0]),
            torch.from_numpy(common),
            torch.from_numpy(clean[2]),
        ).vertices
    shift = (own - shared).mean(dim=1)
    error = 1000.0 * (own - shared - shift[:, None]).norm(dim=-1).mean(dim=1).numpy()
    hand = HandParameters(clean[0], common, clean[2] + shift.numpy(), valid)
    return hand, np.where(valid, error, np.nan)


def convert_capture(
    capture: Capture,
    out: str | os.PathLike[str],
    source: str,
    *,
    overwrite: bool = False,
    settings: FittingSettings | None = None,
) -> dict[str, ConversionError]:
    """Write a capture again with its hands in another hand model; images stay as they are.

    Args:
        capture: the capture.
        out: the capture folder to make.
        source: the model to convert to, as `load_template` takes it.
        overwrite: replace an existing folder.
        settings: steps and weights of the fit.

    Returns:
        The error of the conversion, by side.

    Raises:
        UsageError: `out` exists, or the hand model does not exist.
        BadHandModel: the template that the capture names cannot be loaded.
        BadInput: the template that is loaded is not the capture's.
    """
    info = capture.info
    made, errors = {}, {}
    for side, hand in capture.hands.items():
        target = load_template(source, side)
        made[side], errors[side] = convert_hand(hand, capture.template(side), target, settings)
    note = {side: vars(error) for side, error in errors.items()}
    changed = replace(
        info,
        hand_model=identify_hand_model(source, info.hands),
        source={**info.source, "converted": {"from": info.hand_model.name, "error": note}},
    )
    rewrite_capture(capture, out, changed, made, overwrite=overwrite)
    return errors


def _unshaped(hand: HandParameters) -> HandParameters:
    return replace(hand, betas=np.zeros(10))


def _tensors(hand: HandParameters) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return torch.from_numpy(hand.pose), torch.from_numpy(hand.betas), torch.from_numpy(hand.transl)


#: Mesh formats by the ending of the file; of these only `.glb` keeps two hands apart by name.
FORMATS = (".glb", ".obj", ".ply", ".stl")


def hand_meshes(capture: Capture, frame: int, *, truth: bool = False) -> dict[str, trimesh.Trimesh]:
    """Return the posed meshes of the hands in one frame, by side, in world coordinates, m.

    Args:
        capture: the capture.
        frame: the frame.
        truth: take the true parameters, which simulated captures know, instead of the estimates.

    Raises:
        UsageError: there is no such frame, or the capture does not know the truth.
        BadInput: the hand model that is installed here is another than the capture's.
    """
    poses = capture.hand_poses(frame)
    hands = capture.hands
    if truth:
        known = capture.true_hands
        if known is None:
            raise UsageError(
                "does not know the true hand parameters",
                where=capture.root,
                remedy="Only simulated captures do; leave out --truth.",
            )
        hands = known
    meshes = {}
    for side in poses:
        template, hand = capture.template(side), hands[side]
        arrays = (hand.pose[frame : frame + 1], hand.betas, hand.transl[frame : frame + 1])
        tensors = [torch.from_numpy(np.asarray(array, dtype=np.float64)) for array in arrays]
        posed = pose_hand(template.to_torch(torch.float64), tensors[0], tensors[1], tensors[2])
        meshes[side] = to_trimesh(posed.vertices[0], template.faces)
    return meshes


def write_meshes(meshes: dict[str, trimesh.Trimesh], path: str | os.PathLike[str]) -> Path:
    """Write meshes into one file, whose ending says the format.

    Args:
        meshes: by name.
        path: a file that ends in one of `FORMATS`; replaced if it exists.

    Raises:
        UsageError: the ending is not a known format.
        HwpError: the file cannot be written.
    """
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
