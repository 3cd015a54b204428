"""A capture that the plain avatar can explain, since it is drawn with one; and a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from hwp_bench.base.images import as_uint8
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, HandModelId
from hwp_bench.capture.folder import open_capture
from hwp_bench.hands import load_template
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import Avatar, Camera, HandPose, TrainingCapture
from wildghand.plain.model import PlainAvatar, make_model

#: Frames and edge of the capture.
FRAMES, SIZE = 40, 64
#: Settings of a fit that takes about a second.
QUICK = {"gaussians": 600, "steps": 100, "batch": 1, "device": "cpu"}

#: Makes what a method is given: (hands, **settings).
TrainingMaker = Callable[..., TrainingCapture]


class SilentReport:
    """Keeps what a method reports; its clock runs one second for each offer."""

    def __init__(self) -> None:
        self.offers: list[tuple[int, Avatar]] = []
        self.done: list[tuple[int, int]] = []
        self.elapsed = 0.0

    def __call__(self, step: int, avatar: Avatar) -> None:
        self.offers.append((step, avatar))
        self.elapsed += 1.0

    def progress(self, done: int, total: int) -> None:
        self.done.append((done, total))


def masked_psnr(avatar: Avatar, training: TrainingCapture, capture: Capture) -> float:
    """PSNR over the pixels of the hand in all test frames, dB; these frames are as painted."""
    errors = []
    for frame in training.targets.tolist():
        rgba = avatar.render(training.hand_poses(frame), training.camera(frame))
        inside = capture.mask(frame) == 255
        error = rgba[..., :3] - capture.frame(frame) / 255.0
        errors.append(np.square(error[inside]).mean())
    return -10.0 * math.log10(np.mean(errors))


def hand_parameters(side: str, seed: int) -> HandParameters:
    """A hand upright before the camera that turns and bends its fingers."""
    random = np.random.default_rng(seed)
    phase = 2 * np.pi * np.arange(FRAMES)[:, None, None] / 17.0
    pose = 0.15 * np.sin(phase * random.uniform(0.5, 1.5, (16, 3)) + random.uniform(0, 6, (16, 3)))
    pose[:, 0] += [np.pi / 2, 0.0, 0.0]
    towards = 1.0 if side == "right" else -1.0
    transl = np.tile([0.09 * towards, 0.0, 0.45], (FRAMES, 1))
    return HandParameters(
        pose=pose, betas=np.zeros(10), transl=transl, valid=np.ones(FRAMES, dtype=bool)
    )


def cameras() -> Cameras:
    K = np.array([[1.4 * SIZE, 0, SIZE / 2], [0, 1.4 * SIZE, SIZE / 2], [0, 0, 1.0]])
    return Cameras(np.repeat(K[None], FRAMES, 0), np.repeat(np.eye(4)[None], FRAMES, 0))


def painted_avatar(sides: tuple[str, ...]) -> PlainAvatar:
    """An opaque avatar with a smooth texture under a light from one side."""
    templates = {side: load_template("anny", side) for side in sides}
    model = make_model(
        templates,
        torch.tensor([0.7, 0.5, 0.4]),
        gaussians=2500,
        opacity=0.98,
        degree=1,
        seed=7,
        device=torch.device("cpu"),
    )
    with torch.no_grad():
        model.light.copy_(torch.tensor([[0.1], [-0.15], [0.05]]).expand(3, 3))
        for section, rig in zip(model.sections(sides), model.rigs.values(), strict=True):
            template = rig.template
            corners = template.vertices[template.faces[rig.anchors.face_index]]
            place = (corners * rig.anchors.barycentric[..., None]).sum(dim=1)
            model.gaussians.logit_colors[section] += 0.8 * torch.sin(60.0 * place)
    return PlainAvatar(model, 0)


def painted_info(identifier: str, hands: str = "right") -> CaptureInfo:
    """The information of a small capture of waving hands."""
    template = load_template("anny", "left" if hands == "left" else "right")
    return CaptureInfo(
        id=identifier,
        hands=hands,
        action="Waving",
        device="Test",
        fps=30.0,
        width=SIZE,
        height=SIZE,
        frame_count=FRAMES,
        hand_model=HandModelId(template.name, template.digest),
        perturbations={},
        source={"kind": "test"},
        licence="CC0",
    )


def write_drawn(
    path: Path, info: CaptureInfo, parameters: Mapping[str, HandParameters], avatar: Avatar
) -> Capture:
    """Write a capture whose frames an avatar draws before a gray wall."""
    clip = cameras()
    with CaptureWriter(path, info, parameters, clip) as writer:
        for frame in range(FRAMES):
            poses = {
                side: HandPose(side, hand.pose[frame], hand.betas, hand.transl[frame])
                for side, hand in parameters.items()
            }
            camera = Camera(clip.Ks[frame], clip.viewmats[frame], SIZE, SIZE)
            rgba = avatar.render(poses, camera).astype(np.float64)
            image = rgba[..., :3] + (1.0 - rgba[..., 3:]) * 0.35
            writer.frame(frame, as_uint8(image))
            writer.mask(frame, np.where(rgba[..., 3] > 0.5, 255, 0).astype(np.uint8))
    return open_capture(path)


def paint_capture(path: Path, hands: str) -> Capture:
    """Write a capture of `right`, `left` or `both` hands."""
    sides = {"both": ("right", "left")}.get(hands, (hands,))
    parameters = {side: hand_parameters(side, index) for index, side in enumerate(sides)}
    info = painted_info(f"painted-{hands}", hands)
    return write_drawn(path, info, parameters, painted_avatar(sides))
