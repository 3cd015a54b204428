"""Errors of estimated hands: of captures, and of a tracker, measured and as scenes simulate them.

Run from the repository: `python -m benchmarks.tracker_errors CAPTURE...` prints how far the hands
that methods get are from the true ones, joint by joint, over time and by pose. A capture without
truth has only its jitter (second differences), which true motion enlarges.

`python -m benchmarks.tracker_errors --video VIDEO --landmarks NPZ --keep FOLDER` measures a tracker
and the importer's fit. There is no truth in a real clip; so it is done in two steps. First the
landmarks' distances from the clip's fit: their size, growth in fists and edge-on views, and
memory. Then simulated clips, whose true landmarks get such errors, pass the same importer, and
its parameters are compared with the true ones. The same poses with the errors of scenes that say
`[estimator] kind = "tracker"` stand next to it. `--picture FILE` draws that. It takes about ten
minutes on two cores; FOLDER keeps what was computed. Constants of
`hwp_bench/sim/produce/estimates.py` are those that it prints.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.landmark_errors import LandmarkErrors, landmark_errors, real_clip
from benchmarks.tracker_clips import FPS, RoundTrip, round_trip
from hwp_bench.capture import open_capture
from hwp_bench.hands import load_template
from hwp_bench.hands.poses import hand_extent, posed_skeleton, rest_skeleton, turned
from hwp_bench.hands.skeleton import JOINT_NAMES, HandParameters
from hwp_bench.importers.shared.landmarks import LANDMARK_NAMES
from hwp_bench.sim.produce.estimates import GAIN, curl, landmark_noise, parameter_errors

#: Distances in time at which errors are correlated, s.
LAGS = (1 / 30, 1 / 6, 1 / 3, 1 / 2, 1.0)
#: Simulated clips, where no other number is asked for.
CLIPS = 2
#: Groups of frames, from open hands to fists.
GROUPS = 6


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of several clips of one length."""

    #: (C, F, 16, 3) rad, about the joints' own axes.
    turn: np.ndarray
    #: (C, F, 3) m.
    shift: np.ndarray
    #: (C, F) of the true pose.
    curl: np.ndarray
    #: (C, F, 21) distance in the image, shares of the hand's extent.
    image: np.ndarray
    #: Frames per second.
    fps: float = FPS

    @property
    def moving(self) -> np.ndarray:
        """Errors without the part that never changes in a clip."""
        return self.turn - self.turn.mean(axis=1, keepdims=True)


def pose_error(estimate: HandParameters, truth: HandParameters) -> np.ndarray:
    """Turn from the true to the estimated rotation of each joint: (F, 16, 3) rad, its own axes."""
    from scipy.spatial.transform import Rotation

    true, found = (Rotation.from_rotvec(hand.pose.reshape(-1, 3)) for hand in (truth, estimate))
    return np.asarray((true.inv() * found).as_rotvec().reshape(truth.pose.shape))


def image_error(
    estimate: HandParameters, truth: HandParameters, views: np.ndarray, model: str, side: str
) -> np.ndarray:
    """Distance of the landmarks in the image: (F, 21), shares of the hand's extent."""
    template = load_template(model, side)
    slopes = []
    for hand in (estimate, truth):
        rest = rest_skeleton(template, hand.betas)
        points = posed_skeleton(rest, hand.pose, hand.transl).seen_by(views).landmarks
        slopes.append(points[..., :2] / points[..., 2:])
    extent = hand_extent(points)
    return np.asarray(np.linalg.norm(slopes[0] - slopes[1], axis=-1) / extent)


def measured(trips: list[RoundTrip]) -> PoseErrors:
    """Errors of the importer."""
    return gathered([(trip.estimate, trip.truth) for trip in trips])


def simulated(trips: list[RoundTrip]) -> PoseErrors:
    """Errors as scenes simulate them, on the same poses."""
    template = load_template("anny", "right")
    pairs = []
    for seed, trip in enumerate(trips):
        truth = trip.truth
        rest, views = rest_skeleton(template, truth.betas), _still(truth)
        rng = np.random.default_rng(seed)
        noise = GAIN * landmark_noise(rng, truth.frame_count, 1.0 / FPS)
        errors = parameter_errors(rest, truth.pose, truth.transl, views, noise)
        pose, transl = turned(truth.pose, errors.turn), truth.transl + errors.shift
        pairs.append((HandParameters(pose, truth.betas, transl, truth.valid), truth))
    return gathered(pairs)


def gathered(pairs: list[tuple[HandParameters, HandParameters]]) -> PoseErrors:
    """Errors of estimates against truths that a camera at the origin saw."""
    return PoseErrors(
        turn=np.array([pose_error(*pair) for pair in pairs]),
        shift=np.array([one.transl - other.transl for one, other in pairs]),
        curl=np.array([curl(truth.pose) for _, truth in pairs]),
        image=np.array([image_error(*pair, _still(pair[1]), "anny", "right") for pair in pairs]),
    )


def _still(hand: HandParameters) -> np.ndarray:
    return np.tile(np.eye(4), (hand.frame_count, 1, 1))


def rms(values: np.ndarray, axis: tuple[int, ...] | None = None) -> np.ndarray:
    """Root mean square."""
    return np.asarray(np.sqrt(np.square(values).mean(axis=axis)))


def correlation(moving: np.ndarray, lag: int) -> float:
    """Correlation of errors (C, F, ...) that lie some frames apart."""
    if lag >= moving.shape[1] or lag < 1 or not moving.any():
        return float("nan")
    product = (moving[:, lag:] * moving[:, :-lag]).mean()
    return float(product / np.square(moving).mean())


def by_curl(errors: PoseErrors) -> list[tuple[float, float]]:
    """Mean curl and error of groups of frames, from open hands to fists."""
    size = rms(errors.moving, (2, 3)).reshape(-1)
    bends = errors.curl.reshape(-1)
    groups = np.array_split(np.argsort(bends), GROUPS)
    return [(float(bends[rows].mean()), float(rms(size[rows]))) for rows in groups]


def chain(errors: PoseErrors) -> tuple[float, float, float]:
    """Correlation of the bends of knuckle and middle joint, middle and last, wrist and knuckle."""
    bends = errors.moving.reshape(-1, 16, 3)[:, :, 2]
    with np.errstate(invalid="ignore"):
        table = np.corrcoef(bends.T)
    first = [JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "ring", "little")]
    pairs = ([(k, k + 1) for k in first], [(k + 1, k + 2) for k in first], [(0, k) for k in first])
    one, two, three = (float(np.mean([table[a, b] for a, b in row])) for row in pairs)
    return one, two, three


def habit(errors: PoseErrors) -> float:
    """Share of the errors' variance that never changes in a clip."""
    return float(np.square(errors.turn.mean(axis=1)).mean() / max(rms(errors.turn) ** 2, 1e-30))


def print_landmarks(errors: LandmarkErrors) -> None:
    """Print the constants of simulated trackers."""
    image = rms(errors.image / errors.grown[:, None, None], (0, 2))
    world = rms(errors.world / errors.grown[:, None, None], (0, 2))
    axes = rms(errors.world, (0, 1)) / rms(errors.world)
    print("landmark | in the image, % of the hand's extent | in the world, mm")
    for name, share, metres in zip(LANDMARK_NAMES, image, world, strict=True):
        print(f"{name} | {100 * share:.2f} | {1000 * metres:.1f}")
    print(f"axes of the world: {', '.join(f'{value:.2f}' for value in axes)}")
    print(f"growth (still, curl, edge-on): {', '.join(f'{v:.2f}' for v in errors.growth)}")
    print(f"correlation from frame to frame: {errors.memory:.2f}")


def print_poses(found: dict[str, PoseErrors]) -> None:
    """Print errors of parameters next to each other."""
    names = list(found)
    print(f"joint | {' | '.join(f'{name}, rad' for name in names)}")
    for row, joint in enumerate(JOINT_NAMES):
        values = [f"{rms(item.moving[:, :, row]):.3f}" for item in found.values()]
        print(f"{joint} | {' | '.join(values)}")
    for name, item in found.items():
        near = ", ".join(
            f"{lag:.2f} s {correlation(item.moving, round(lag * item.fps)):.2f}" for lag in LAGS
        )
        bends = ", ".join(f"{bend:.2f}: {size:.3f}" for bend, size in by_curl(item))
        links = ", ".join(f"{value:.2f}" for value in chain(item))
        shift = item.shift - item.shift.mean(axis=1, keepdims=True)
        print(f"{name}: all {rms(item.moving):.3f} rad; never changes {habit(item):.2f}")
        print(f"  correlation after {near}")
        print(f"  by curl {bends}; knuckle-middle, middle-last, wrist-knuckle {links}")
        print(f"  landmarks in the image {100 * rms(item.image):.2f} % of the hand's extent")
        print(f"  place {', '.join(f'{1000 * value:.1f}' for value in rms(shift, (0, 1)))} mm")


def draw(found: dict[str, PoseErrors], path: Path) -> None:
    """Draw errors by joint, over time and by curl."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    joints, memory, bends = figure.subplots(1, 3, width_ratios=(2.2, 1.0, 1.0))
    places = np.arange(len(JOINT_NAMES))
    for index, (name, item) in enumerate(found.items()):
        values = [rms(item.moving[:, :, row]) for row in range(16)]
        joints.bar(places + 0.4 * index - 0.2, values, 0.4, label=name)
        lags = range(1, 31)
        memory.plot([lag / FPS for lag in lags], [correlation(item.moving, k) for k in lags])
        bends.plot(*zip(*by_curl(item), strict=True), marker="o", markersize=3)
    joints.set_xticks(places, JOINT_NAMES, rotation=60, fontsize=7)
    joints.set_ylabel("error, rad")
    joints.legend(fontsize=7, frameon=False)
    memory.set_xlabel("seconds between frames")
    memory.set_ylabel("correlation")
    bends.set_xlabel("curl (1 is a fist)")
    bends.set_ylim(bottom=0.0)
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 85})


def print_capture(path: Path) -> None:
    """Print the errors, or the jitter, of the hands of a capture."""
    capture = open_capture(path)
    truth = capture.true_hands
    for side, hand in capture.hands.items():
        if truth is None:
            second = hand.pose[2:] - 2.0 * hand.pose[1:-1] + hand.pose[:-2]
            jitter = rms(second, (0, 2)) / np.sqrt(6.0)
            values = ", ".join(f"{n} {v:.3f}" for n, v in zip(JOINT_NAMES, jitter, strict=True))
            print(f"{path.name}, {side}, no truth: jitter with true motion, rad: {values}")
            continue
        turn = pose_error(hand, truth[side])[None]
        image = image_error(
            hand, truth[side], capture.cameras.viewmats, capture.info.hand_model.source, side
        )[None]
        shift = (hand.transl - truth[side].transl)[None]
        errors = PoseErrors(turn, shift, curl(truth[side].pose)[None], image, capture.info.fps)
        print(f"{path.name}, {side}: {100 * (1 - hand.valid.mean()):.1f} % not valid")
        print_poses({"estimate": errors})


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("captures", nargs="*", type=Path, help="captures")
    parser.add_argument("--video", type=Path, help="a real clip of one hand")
    parser.add_argument("--landmarks", type=Path, help="its landmarks")
    parser.add_argument("--keep", type=Path, default=Path("tracker"), help="folder (tracker)")
    parser.add_argument("--clips", type=int, default=CLIPS, help=f"simulated clips ({CLIPS})")
    parser.add_argument("--picture", type=Path, help="a picture to write")
    args = parser.parse_args()
    for path in args.captures:
        print_capture(path)
    if args.video is None or args.landmarks is None:
        return 0
    if not args.video.exists() or not args.landmarks.exists():
        print(f"skipped: {args.video} or {args.landmarks} is not here")
        return 0
    args.keep.mkdir(parents=True, exist_ok=True)
    errors = landmark_errors(real_clip(args.video, args.landmarks, args.keep))
    print_landmarks(errors)
    trips = [round_trip(seed + 1, errors, args.keep) for seed in range(args.clips)]
    found = {"importer": measured(trips), "simulated": simulated(trips)}
    print_poses(found)
    if args.picture is not None:
        draw(found, args.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
