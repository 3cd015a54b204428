"""Errors of the video importer against the truth of simulated clips, with and without its terms.

Run from the repository: `python -m benchmarks.importer_errors FOLDER` imports the clips that
`python -m benchmarks.tracker_errors --video VIDEO --landmarks NPZ --keep FOLDER` left there and
prints how far the hands are from the true ones. `--set NAME=VALUE` changes a number of
`hwp_bench.importers.video.SolveSettings`, for example `--set texture=false`. About two minutes
of one core for each clip.

`--harder` adds two clips, which are rendered where FOLDER does not hold them: one in hard light,
and one of a person whom no shape of the hand model fits (other bones, thickness, joints and
skinning). Of that person the surface at rest is an error of its own, which no pose takes away.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.landmark_errors import kept_clip, landmark_errors
from benchmarks.tracker_clips import clip_source, make_clip, true_hand
from hwp_bench.cli.options import overrides
from hwp_bench.hands import HandTemplate, PosedHand, load_template, pose_hand
from hwp_bench.hands.skeleton import FINGERS, HandParameters, finger_joints
from hwp_bench.importers.video import SolveSettings
from hwp_bench.importers.video.api import fit_video
from hwp_bench.methods.settings import settings_from

#: Seeds and kinds of the harder clips.
HARDER = ((11, "hard-light"), (12, "off-model"))


@dataclass(frozen=True)
class HandErrors:
    """Mean distances from the true hand; nothing is aligned in the image."""

    #: Joints in space, mm.
    joints: float
    #: Vertices in space with both wrists laid on each other, mm.
    shape: float
    #: Joints in the image, px.
    image_joints: float
    #: Vertices in the image, px.
    image: float
    #: Vertices in the image, px: palm, then the five fingers.
    parts: tuple[float, ...]
    #: Rotation of the wrist, degrees.
    wrist: float


def hand_errors(
    estimate: HandParameters,
    truth: HandParameters,
    focal: float,
    template: HandTemplate,
    true_template: HandTemplate,
) -> HandErrors:
    """Compare two hands that a camera at the origin with a focal length in px sees.

    Args:
        estimate: as found.
        truth: the true one.
        focal: in px.
        template: that the estimate is posed with.
        true_template: that the truth is posed with, of the same triangles.
    """
    from scipy.spatial.transform import Rotation

    def posed(hand: HandParameters, at_rest: HandTemplate) -> PosedHand:
        parts = (torch.from_numpy(part) for part in (hand.pose, hand.betas, hand.transl))
        return pose_hand(at_rest.to_torch(torch.float64), *parts)

    found, true = posed(estimate, template), posed(truth, true_template)

    def apart(first: torch.Tensor, second: torch.Tensor) -> np.ndarray:
        return np.asarray(torch.linalg.vector_norm(first - second, dim=-1).numpy())

    def seen(points: torch.Tensor) -> torch.Tensor:
        return points[..., :2] / points[..., 2:] * focal

    image = apart(seen(found.vertices), seen(true.vertices))
    owner = template.weights.argmax(axis=1)
    groups = [(0,), *(finger_joints(name) for name in FINGERS)]
    shapes = [hand.vertices - hand.joints[:, :1] for hand in (found, true)]
    roots = [Rotation.from_rotvec(hand.pose[:, 0]) for hand in (truth, estimate)]
    return HandErrors(
        joints=1e3 * float(apart(found.joints, true.joints).mean()),
        shape=1e3 * float(apart(*shapes).mean()),
        image_joints=float(apart(seen(found.joints), seen(true.joints)).mean()),
        image=float(image.mean()),
        parts=tuple(float(image[:, np.isin(owner, group)].mean()) for group in groups),
        wrist=float(np.degrees((roots[0].inv() * roots[1]).magnitude().mean())),
    )


def import_errors(folder: Path, clip: str, settings: SolveSettings) -> tuple[HandErrors, float]:
    """Import a kept clip: its errors, and the processor seconds that it took."""
    source, options = clip_source(clip, folder, settings)
    start = time.process_time()
    hand = fit_video(source, options).first.parameters
    taken = time.process_time() - start
    own, truth = true_hand(folder / clip)
    assert options.focal is not None
    return hand_errors(hand, truth, options.focal, load_template("anny", "right"), own), taken


def changed(settings: SolveSettings, changes: list[str]) -> SolveSettings:
    """Set fields given as NAME=VALUE; refuses names and values that are wrong."""
    values = {**asdict(settings), **overrides(changes)}
    return settings_from(SolveSettings, values, "--set")


def main(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--harder", action="store_true", help="also hard light, and another mesh")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes")
    options = parser.parse_args(arguments)
    settings = changed(SolveSettings(), options.changes)
    if options.harder:
        errors = landmark_errors(kept_clip(options.folder))
        for seed, kind in HARDER:
            make_clip(seed, kind, errors, options.folder)
    parts = " ".join(f"{name:>7}" for name in ("palm", *FINGERS))
    print(f"clip              joints mm  shape mm  joints px  surface px  wrist deg {parts}  cpu s")
    for path in sorted(options.folder.glob("clip*.avi")):
        found, taken = import_errors(options.folder, path.stem, settings)
        row = " ".join(f"{value:7.2f}" for value in found.parts)
        print(
            f"{path.stem:17} {found.joints:9.2f} {found.shape:9.2f} {found.image_joints:10.3f}"
            f" {found.image:11.3f} {found.wrist:10.2f} {row} {taken:6.0f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
