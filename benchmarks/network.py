"""What the prediction network costs, and how sharp it fits next to Gaussians fitted directly.

Run from the repository:
`python -m benchmarks.network time [--size compact|paper] [--gaussians N] [--threads 2]` times one
hand in one frame, only the network (on a busy machine read the processor time, with one thread);
`python -m benchmarks.network fit CAPTURE [--steps 600] [--frames clean]` fits a capture of one
hand twice, by the same loss, frames and number of steps: Gaussians whose attributes are free (the
plain baseline), and the network, each at its own learning rates. PSNR is over the hand, on the
test frames and on every fifth training frame.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hwp_bench.base.tables import Column, Table, print_table
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import split_for
from hwp_bench.hands import load_template
from hwp_bench.methods.contract import RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from wildghand.gaussians.fit_loop import batches
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.quaternions import quat_multiply, quat_rotate, quat_third_axis
from wildghand.gaussians.rig import make_rig
from wildghand.gaussians.training import TrainingClip, TrainingFrames, load_frames, soft_weights
from wildghand.network import (
    PredictionNetwork,
    network_settings,
    parameter_groups,
    surface_points,
)
from wildghand.plain.model import make_model
from wildghand.plain.recipe import FitSettings, learning_rates
from wildghand.splat import rasterize

#: Gaussians of the stated cost.
GAUSSIANS = 12_337
#: Adam's steps at the start, by group; `refinement` stays off, as it is in the plain baseline.
RATES = {"identity": 0.03, "direct": 1e-3, "light": 0.01, "refinement": 0.0, "network": 0.01}
#: The rates fall geometrically to this share of their start.
FINAL = 0.05

Render = Callable[[TrainingClip, torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Contender:
    """Something that can be fitted."""

    name: str
    #: Parameters and learning rates.
    groups: list[dict[str, object]]
    #: Draws the frames of a clip: (B, H, W, 3).
    render: Render


def time_network(size: str, count: int, rounds: int) -> Table:
    """Median milliseconds of one hand in one frame."""
    template = load_template()
    rig = make_rig(template, count)
    surface = surface_points(template, rig.anchors, rig.spacing, torch.full((3,), 0.5))
    network = PredictionNetwork(network_settings(size), {"right": surface})
    optimizer = torch.optim.Adam(network.parameters(), fused=True)
    normals = torch.nn.functional.normalize(torch.randn(1, count, 3), dim=-1)
    pose = 0.3 * torch.randn(1, 16, 3)
    rows, processor = [], []
    for _ in range(rounds + 2):
        spent = time.process_time()
        marks = [time.perf_counter()]
        features = network.features("right")
        marks.append(time.perf_counter())
        prediction = network("right", normals, pose, features)
        marks.append(time.perf_counter())
        loss = prediction.raw.concatenate().square().mean() + prediction.shadow.mean()
        loss = loss + prediction.template_offsets.sum() + prediction.refinement.pose.sum()
        optimizer.zero_grad()
        loss.backward()
        marks.append(time.perf_counter())
        optimizer.step()
        marks.append(time.perf_counter())
        rows.append(np.diff(marks))
        processor.append(time.process_time() - spent)
    steps = 1e3 * np.array(rows[2:])
    cells = tuple(np.median(steps, axis=0).tolist())
    names = ("shared features", "of the frame", "backward", "Adam")
    totals = ("all", "fastest", "processor, fastest")
    columns = tuple(Column(name, 1) for name in (*names, *totals))
    whole = steps.sum(axis=1)
    row = (*cells, float(np.median(whole)), float(whole.min()), 1e3 * min(processor[2:]))
    caption = f"{size}, {count:,} Gaussians, {torch.get_num_threads()} threads: ms"
    return Table(caption, columns, (row,), ranked=False)


def measure(size: str = "compact", count: int = 5_000, rounds: int = 12) -> Mapping[str, float]:
    """Ratios of processor seconds by name, lower is better, on one thread.

    The reference is the rasterizer: as many Gaussians on a hand that fills 176 px, both passes.

    Args:
        size: of the network.
        count: Gaussians.
        rounds: turns of each.
    """
    from benchmarks.splat import Contender as Drawing
    from benchmarks.splat import ours, race
    from benchmarks.splat_workloads import make

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        network = float(str(time_network(size, count, rounds).rows[0][-1]))
        drawn = race([Drawing("one", ours("numba"))], make(count, 176), rounds)["one"]
        fastest = 1e3 * min(processor for *_, processor in drawn.rows)
        return {"network / rasterizer": network / fastest}
    finally:
        torch.set_num_threads(before)


def plain(training: TrainingCapture, frames: TrainingFrames, count: int) -> Contender:
    """Free attributes of every Gaussian, as the plain baseline fits them."""
    settings = FitSettings()
    model = make_model(
        {side: training.template(side) for side in training.sides},
        frames.mean_color(),
        gaussians=count,
        opacity=settings.initial_opacity,
        degree=settings.shading_degree,
        seed=0,
        device=torch.device("cpu"),
    )
    rates = learning_rates(settings)
    groups: list[dict[str, object]] = [
        {"params": [tensor.requires_grad_()], "lr": rates[name]}
        for name, tensor in model.parameters().items()
    ]

    def render(clip: TrainingClip, rows: torch.Tensor) -> torch.Tensor:
        cameras = clip.viewmats[rows], clip.Ks[rows]
        return model.render(clip.poses(rows), *cameras, training.width, training.height)[0]

    return Contender("plain", groups, render)


def predicted(
    training: TrainingCapture, frames: TrainingFrames, count: int, size: str
) -> Contender:
    """Attributes that the network predicts, and nothing else of the method."""
    side = training.sides[0]
    template = training.template(side)
    rig = make_rig(template, count)
    surface = surface_points(template, rig.anchors, rig.spacing, frames.mean_color())
    network = PredictionNetwork(network_settings(size), {side: surface})
    groups: list[dict[str, object]] = [
        {"params": parameters, "lr": RATES[name]}
        for name, parameters in parameter_groups(network).items()
        if parameters
    ]

    def render(clip: TrainingClip, rows: torch.Tensor) -> torch.Tensor:
        anchors = clip.hand(side, rows)
        normals = quat_third_axis(anchors.orientations)
        prediction = network(side, normals, clip.parameters[side][0][rows])
        drawn = network.activation(prediction.raw)
        offsets = drawn.offsets + prediction.template_offsets
        return rasterize(
            anchors.positions + quat_rotate(anchors.orientations, offsets),
            quat_multiply(anchors.orientations, drawn.quats),
            drawn.scales,
            drawn.opacities,
            drawn.colors * prediction.shadow,
            clip.viewmats[rows],
            clip.Ks[rows],
            training.width,
            training.height,
        )[0]

    return Contender(size, groups, render)


def fit(contender: Contender, clip: TrainingClip, frames: TrainingFrames, steps: int) -> float:
    """Fit in place; returns the mean milliseconds of a step."""
    optimizer = torch.optim.Adam(contender.groups, eps=1e-15, betas=(0.9, 0.99), fused=True)
    starts = [group["lr"] for group in optimizer.param_groups]
    order = batches(len(frames), 1, seed=0)
    images, masks = (table(torch.device("cpu")) for table in (frames.images_on, frames.masks_on))
    began = time.perf_counter()
    for step in range(steps):
        for group, start in zip(optimizer.param_groups, starts, strict=True):
            group["lr"] = start * FINAL ** (step / steps)
        rows = next(order)
        image = contender.render(clip, rows)
        optimizer.zero_grad()
        weights = soft_weights(masks(rows), 0.03)
        photometric_loss(image, images(rows), weights, 0.2).backward()
        optimizer.step()
    return 1e3 * (time.perf_counter() - began) / steps


@torch.no_grad()
def mean_psnr(
    render: Render, clip: TrainingClip, truth: list[tuple[torch.Tensor, torch.Tensor]], every: int
) -> float:
    """Mean PSNR in dB over the hand, on every n-th frame of a clip."""
    scores = []
    for row in range(0, len(truth), every):
        image, mask = truth[row]
        error = render(clip, torch.tensor([row]))[0].clamp(0.0, 1.0) - image
        scores.append(-10.0 * float(error[mask].square().mean().log10()))
    return float(np.mean(scores))


def _truth(capture: Capture, frame: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A test frame, and where it is scored."""
    image, mask = capture.frame(frame), capture.scoring_mask(frame)[0]
    return torch.from_numpy(image).float() / 255.0, torch.from_numpy(mask == 255)


def compare(capture: Capture, args: argparse.Namespace) -> Table:
    """Fit both contenders to a capture of one hand."""
    split = split_for(capture.info.id, capture.info.frame_count)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        run = RunSettings({}, frames=args.frames)
        training = open_request(write_request(Path(folder) / "request", capture, split, run))
        frames = load_frames(training)
        rigs = {side: make_rig(training.template(side), args.gaussians) for side in training.sides}
        clip = TrainingClip(training, frames.indices, rigs, torch.device("cpu"))
        unseen = TrainingClip(training, split.test, rigs, torch.device("cpu"))
        tests = [_truth(capture, frame) for frame in split.test.tolist()]
        seen = [
            (image.float() / 255.0, mask == 255)
            for image, mask in zip(frames.images, frames.masks, strict=True)
        ]
        for contender in (
            plain(training, frames, args.gaussians),
            predicted(training, frames, args.gaussians, args.size),
        ):
            milliseconds = fit(contender, clip, frames, args.steps)
            scores = (
                mean_psnr(contender.render, unseen, tests, 1),
                mean_psnr(contender.render, clip, seen, 5),
            )
            rows.append((contender.name, *scores, milliseconds))
    columns = (
        Column("attributes"),
        Column("test PSNR, dB", 2, True),
        Column("training PSNR, dB", 2, True),
        Column("ms per step", 1, False),
    )
    caption = f"{capture.info.id}, {capture.info.width} px, {args.frames}, {args.steps} steps"
    return Table(caption, columns, tuple(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    actions = parser.add_subparsers(dest="action", required=True)
    timing = actions.add_parser("time")
    fitting = actions.add_parser("fit")
    timing.add_argument("--rounds", type=int, default=20)
    fitting.add_argument("capture")
    fitting.add_argument("--steps", type=int, default=600)
    fitting.add_argument("--frames", choices=("clean", "perturbed"), default="clean")
    for part in (timing, fitting):
        part.add_argument("--size", choices=("compact", "paper"), default="compact")
        part.add_argument("--gaussians", type=int, default=GAUSSIANS)
        part.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.action == "time":
        print_table(time_network(args.size, args.gaussians, args.rounds))
    else:
        print_table(compare(open_capture(args.capture), args))


if __name__ == "__main__":
    main()
