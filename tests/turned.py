"""A capture of a simulated person's hand that shows its palm first and its back last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from painted import FRAMES, hand_parameters, painted_info, write_drawn

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import SurfaceAnchors, anchor_uv, load_template
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.sim.subject.hand import painted_atlas, subject_hand
from hwp_bench.sim.subject.subject import Subject
from wildghand.network.surface import PlaneSampler
from wildghand.plain.model import PlainAvatar, make_model

#: A dark person with pale palms, whom no prior has seen.
STRANGER = Subject(seed=910_357, tone=1.0, age=40.0)
# Texels along an edge of the skin.
_EDGE = 256


def turning_hand() -> HandParameters:
    """A right hand that shows its palm while methods learn, and its back when they are tested."""
    from scipy.spatial.transform import Rotation

    hand = hand_parameters("right", 0)
    last = contiguous_split("turned", FRAMES).test[0]
    angle = np.radians(np.linspace(-35.0, 35.0, FRAMES))
    angle[last:] = np.radians(np.linspace(160.0, 200.0, FRAMES - last))
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    turns = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 1.0, 0.0])) * upright
    pose = hand.pose.copy()
    pose[:, 0] = turns.as_rotvec()
    # The middle of the hand stays where it is.
    middle = load_template("anny", "right").vertices.mean(axis=0)
    root = load_template("anny", "right").joints[0]
    shift = turns.apply(np.tile(middle - root, (FRAMES, 1))) + root
    transl = np.array([0.0, 0.0, 0.45]) - shift
    return HandParameters(pose=pose, betas=hand.betas, transl=transl, valid=hand.valid)


def avatar_of(subject: Subject) -> PlainAvatar:
    """The hand of a person, opaque, under a soft light."""
    template = load_template("anny", "right")
    model = make_model(
        {"right": template},
        torch.full((3,), 0.5),
        gaussians=4000,
        opacity=0.98,
        degree=1,
        seed=7,
        device=torch.device("cpu"),
    )
    anchors = model.rigs["right"].anchors
    uv = anchor_uv(
        template, SurfaceAnchors(np.asarray(anchors.face_index), np.asarray(anchors.barycentric))
    )
    skin = painted_atlas(subject_hand(subject, "right", 1), subject, _EDGE).albedo
    read = PlaneSampler(torch.as_tensor(uv, dtype=torch.float32), _EDGE)
    albedo = read(torch.as_tensor(skin).reshape(_EDGE**2, 3))
    with torch.no_grad():
        srgb = torch.as_tensor(linear_to_srgb(albedo.double().numpy()), dtype=torch.float32)
        model.gaussians.logit_colors.copy_(torch.logit(srgb.clamp(0.02, 0.98)))
        model.light.copy_(torch.tensor([[0.04], [-0.06], [0.02]]).expand(3, 3))
    return PlainAvatar(model, 0)


def paint_turned(path: Path, subject: Subject = STRANGER) -> Capture:
    """Write the capture of a person."""
    info = replace(painted_info("turned"), action="Turning")
    return write_drawn(path, info, {"right": turning_hand()}, avatar_of(subject))


def turned_training(capture: Capture, folder: Path) -> TrainingCapture:
    """The part of it that a method is given."""
    split = contiguous_split(capture.info.id, FRAMES)
    run = RunSettings({}, 0, Budget())
    return open_request(write_request(folder / "request", capture, split, run))
