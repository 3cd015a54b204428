"""The stages from a video to an avatar, those that show it, and the order of all."""

# Methods of a stage are described where `Stage` declares them.
# ruff: noqa: D102

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import notice, track
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.errors import BadInput, HwpError, reason_of
from hwp_bench.base.files import canonical_json, check_is_file, sha256_of, write_json
from hwp_bench.base.images import as_uint8, read_gray, write_image, write_movie
from hwp_bench.capture import Capture, open_capture
from hwp_bench.importers.shared.landmarks import read_hand_tracks, read_sides
from hwp_bench.importers.video import FrameRange, VideoImport, import_video
from hwp_bench.importers.video.api import IMPORTER_VERSION
from hwp_bench.importers.video.decode import probe
from hwp_bench.methods.contract import Budget, HandPose
from hwp_bench.tracking import TrackerSettings, track_video
from hwp_bench.tracking.networks import load_models
from hwp_bench.tracking.track_video import NoHandSeen, landmark_sheet
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import CALL, DESCRIPTION, MODEL, WEIGHTS, load_avatar
from wildghand.avatar.files import SCHEMA as AVATAR_SCHEMA
from wildghand.avatar.studio import REST, Pose
from wildghand.fitting.method import digest_of_named_files
from wildghand.fitting.session import SCHEMA as STATE_SCHEMA
from wildghand.fitting.session import fit_capture, unfinished
from wildghand.from_video.run import Stage, VideoJob, stride
from wildghand.from_video.verdict import judge_avatar, read_verdict
from wildghand.model.settings import read_settings
from wildghand.page import write_page
from wildghand.page.write import start_of_clip

#: Edge of the turntable, px; frames of one turn, and in a second.
SIZE, FRAMES, FPS = 480, 96, 24
#: sRGB grey behind the hand.
BACKGROUND = 28
#: Columns of the sheet, and edge of its pictures, px.
COLUMNS, EDGE = 6, 256


class Turntable:
    """Draws an avatar from all around (`wildghand.avatar.studio`).

    Args:
        avatar: what is drawn; two hands stand next to each other and turn together.
        size: edge of the square pictures, px.
        pose: whose fingers they have; None: at rest.
    """

    def __init__(
        self, avatar: WildGHandAvatar, size: int, pose: Mapping[str, HandPose] | None = None
    ) -> None:
        self._avatar = avatar
        self._camera = avatar.studio.camera(size, size)
        self._poses: dict[str, Pose] = dict.fromkeys(avatar.sides, REST)
        if pose is not None:
            self._poses = {side: pose[side].pose[1:] for side in avatar.sides}

    def view(self, degrees: float) -> np.ndarray:
        """Draw it turned about the vertical, (size, size, 3) uint8; at 0 the palm is in front."""
        hands = self._avatar.studio.posed_each(self._poses, degrees)
        rgba = self._avatar.render(hands, self._camera)
        return as_uint8(rgba[..., :3] + (1.0 - rgba[..., 3:]) * (BACKGROUND / 255.0))


def avatar_sheet(avatar: WildGHandAvatar, capture: Capture, weights: Path) -> np.ndarray:
    """Draw the sheet of an avatar that was fitted to a capture, (H, W, 3) uint8.

    In rows of `COLUMNS`: frames, evenly spaced among those that were fitted; the avatar in their
    poses; how much each pixel counted in the fit, white for most, where the folder `weights` has
    masks; the avatar in a pose of the clip, turned in steps.
    """
    masks = {int(path.stem): path for path in sorted(weights.glob("[0-9]*.png"))}
    fitted_frames = sorted(masks) or avatar.record.frames
    frames = [fitted_frames[pick] for pick in evenly(len(fitted_frames), COLUMNS)]
    rows: list[list[np.ndarray]] = [[], [], []]
    video = capture.info.source.get("video")
    ends_early = isinstance(video, Mapping) and video.get("ends_early") is True
    for frame in frames:
        poses = {s: p for s, p in capture.hand_poses(frame).items() if s in avatar.sides}
        last = " (video ends early)" if ends_early and frame == frames[-1] else ""
        rows[0].append(_tile(capture.frame(frame), f"frame {frame}{last}"))
        drawn = avatar.render(poses, capture.camera(frame))[..., :3]
        rows[1].append(_tile(as_uint8(drawn), "avatar"))
        if frame in masks:
            gray = read_gray(masks[frame], capture.size)
            rows[2].append(_tile(np.repeat(gray[:, :, None], 3, axis=2), "weights"))
    table = Turntable(avatar, EDGE, start_of_clip(avatar, capture))
    angles = [360.0 * step / COLUMNS for step in range(COLUMNS)]
    rows.append([_tile(table.view(angle), f"turned {angle:.0f} degrees") for angle in angles])
    blank = np.full_like(rows[3][0], 250)
    tiles = [tile for row in rows if row for tile in [*row, *[blank] * (COLUMNS - len(row))]]
    return sheet(tiles, COLUMNS)


def _tile(image: np.ndarray, text: str) -> np.ndarray:
    return labelled(fitted(image, EDGE), text)


def avatar_digest(folder: Path) -> str:
    """One digest of an avatar's tensors and description."""
    return sha256_of(folder / MODEL) + sha256_of(folder / DESCRIPTION)


class Picture(Stage):
    """A stage that shows the avatar.

    `look` is everything that the picture depends on besides the avatar, with a version that rises
    when it comes out otherwise.
    """

    def __init__(
        self,
        name: str,
        title: str,
        look: str,
        seconds: float,
        show: Callable[[VideoJob, WildGHandAvatar], object],
    ) -> None:
        self.name = self.makes = name
        self.title, self.look, self.seconds, self.show = title, look, seconds, show

    def facts(self, job: VideoJob) -> dict[str, str]:
        return {"avatar": avatar_digest(job.folder), f"look of the {self.name}": self.look}

    def run(self, job: VideoJob) -> None:
        self.show(job, load_avatar(job.folder, hand=job.options.hand_model))

    def expected(self, job: VideoJob) -> float:
        return self.seconds


def draw_turntable(job: VideoJob, avatar: WildGHandAvatar) -> None:
    """Draw the avatar from all around, as it stands in its studio."""
    table = Turntable(avatar, SIZE, start_of_clip(avatar, open_capture(job.capture)))
    angles = track([360.0 * frame / FRAMES for frame in range(FRAMES)], "drawing the turntable")
    write_movie(job.turntable, (table.view(angle) for angle in angles), FPS)


def write_verdict(job: VideoJob, avatar: WildGHandAvatar) -> None:
    """Judge the avatar by its capture."""
    write_json(job.verdict, asdict(judge_avatar(avatar, open_capture(job.capture))))


def draw_sheet(job: VideoJob, avatar: WildGHandAvatar) -> None:
    """Draw the contact sheet: frames, the avatar in their poses, its weights, and all sides."""
    drawn = avatar_sheet(avatar, open_capture(job.capture), job.folder / WEIGHTS)
    for line in reversed(read_verdict(job.verdict).lines()):
        drawn = labelled(drawn, line)
    write_image(job.sheet, drawn)


def write_avatar_page(job: VideoJob, avatar: WildGHandAvatar) -> None:
    """Write the avatar's page: one file that turns and poses it in a browser."""
    write_page(avatar, job.page, capture=open_capture(job.capture), overwrite=True)


#: Fewest frames with a hand that an avatar is made of.
FEWEST = 12
#: Sheet of a video that shows too few, in the job's folder `work`.
TRACKED = "tracked.jpg"


def _frame_count(job: VideoJob) -> int:
    """Number of frames as the container states it; 600 where it states none."""
    return probe(job.video).stated_frames or 600


class TrackStage(Stage):
    """The landmarks of the hands in the video; nothing where a person gives them."""

    name, title, makes = "track", "Tracking the hand", "landmarks"

    def facts(self, job: VideoJob) -> dict[str, str]:
        given, model = job.options.landmarks, job.options.tracker
        if given is not None:
            check_is_file(given, field="--landmarks")
            return {"landmarks": sha256_of(given)}
        tracker = "shipped" if model is None else load_models(model).digest
        return {"video": sha256_of(job.video), "tracker": tracker}

    def run(self, job: VideoJob) -> None:
        if job.options.landmarks is not None:
            return
        try:
            track_video(
                job.video,
                job.landmarks,
                settings=TrackerSettings(),
                model=job.options.tracker,
                overwrite=True,
                unseen=job.work / TRACKED,
            )
        except NoHandSeen as error:
            raise NoHandSeen(
                error.problem,
                where=error.where,
                remedy="The whole hand must be visible. `hwp-bench data track --min-score 0.3` and "
                "`hwp-bench data import video --landmarks NPZ --min-score 0.3` accept less; then "
                "fit the capture.",
            ) from error

    def expected(self, job: VideoJob) -> float:
        # A frame of 720p takes 18 ms.
        return 0.0 if job.options.landmarks else 1.0 + 0.018 * _frame_count(job)


class Import(Stage):
    """Frames, masks, hand parameters and cameras of the video."""

    name, title, makes = "import", "Importing the hand", "metadata"

    def facts(self, job: VideoJob) -> dict[str, str]:
        return {
            "video": sha256_of(job.video),
            "landmarks": sha256_of(job.landmarks),
            "side": job.options.side,
            "hand model": job.options.hand_model,
            "size": str(job.options.size),
            "number of frames": str(job.options.most_frames),
            "settings of the import": canonical_json(asdict(job.options.importer)),
            "version of the importer": str(IMPORTER_VERSION),
        }

    def run(self, job: VideoJob) -> None:
        options = import_options(job)
        import_video(job.video, job.landmarks, job.capture, options, job.glimpse)

    def expected(self, job: VideoJob) -> float:
        # A frame takes 0.3 s, one that is decoded only 5 ms.
        count = _frame_count(job)
        return 0.3 * (count / stride(count, job.options.most_frames)) + 0.005 * count


def import_options(job: VideoJob) -> VideoImport:
    """Choose the frames and hands of an import; refuse a video that shows too few."""
    choices = VideoImport(
        side=job.options.side,
        id=job.capture_id,
        size=job.options.size,
        hand_model=job.options.hand_model,
        overwrite=True,
        strict=True,
        fit=job.options.importer,
    )
    # Where the landmarks do not say the side, only the import's own fit can tell.
    hands = read_sides(job.landmarks, choices.side, min_score=choices.min_score)
    total = len(next(iter(hands.values())).score)
    step = stride(total, job.options.most_frames)
    taken = len(range(0, total, step))
    of = f"{total} frames" if step == 1 else f"the {taken} frames that are taken of {total}"
    seen = {side: int(np.count_nonzero(hand.detected[::step])) for side, hand in hands.items()}
    few = [side for side, count in seen.items() if count < FEWEST]
    if few and (len(few) == len(seen) or job.options.side == "both"):
        named, shown = f"a {few[0]} hand" if few[0] else "a hand", job.work / TRACKED
        drawn = landmark_sheet(probe(job.video), total, read_hand_tracks(job.landmarks))
        write_image(shown, drawn)
        raise BadInput(
            f"shows {named} in {seen[few[0]]} of {of}, an avatar needs {FEWEST} or more "
            f"({shown} has some of them)",
            where=job.video,
            remedy="Record some seconds in which the whole hand is visible and turns.",
        )
    choices = replace(choices, frames=FrameRange(stride=step))
    if few:
        notice(f"The {few[0]} hand is in {seen[few[0]]} of {of} only and is left out.")
        return replace(choices, side=next(side for side in seen if side not in few) or "auto")
    together = int(np.all([hand.detected[::step] for hand in hands.values()], axis=0).sum())
    if together >= FEWEST:
        return choices
    # A fit takes the frames that show all of its hands.
    if job.options.side == "both":
        raise BadInput(
            f"shows both hands together in {together} of {of}, an avatar of two needs {FEWEST} or "
            "more",
            where=job.video,
            remedy="Film the hands together, or make an avatar of one.",
        )
    side, other = sorted(seen, key=lambda name: -seen[name])
    notice(
        f"Both hands are in {together} of {of} only; the {other} hand is left out (--side {other} "
        "takes it instead)."
    )
    return replace(choices, side=side or "auto")


class FitStage(Stage):
    """The avatar, fitted to the capture."""

    name, title, makes, together = "fit", "Fitting the avatar", "fit", True

    def facts(self, job: VideoJob) -> dict[str, str]:
        options = job.options
        return {
            "version": f"{AVATAR_SCHEMA}, {STATE_SCHEMA}",
            "capture": open_capture(job.capture).digest,
            "settings": canonical_json(options.method_settings()),
            "files that settings name": digest_of_named_files(
                read_settings(options.method_settings())
            ),
            "steps": str(options.steps),
            "seconds": str(options.seconds),
            "seed": str(options.seed),
            "choice of frames": "all" if options.all_frames else "split",
        }

    def run(self, job: VideoJob) -> None:
        options = job.options
        fit_capture(
            job.capture,
            job.fitted,
            settings=options.method_settings(),
            budget=Budget(options.seconds, options.steps),
            seed=options.seed,
            all_frames=options.all_frames,
            overwrite=True,
            world=job.world,
            watch=job.watch,
        )

    def discard(self, job: VideoJob) -> None:
        shutil.rmtree(unfinished(job.fitted), ignore_errors=True)

    def expected(self, job: VideoJob) -> float:
        settings = read_settings(job.options.method_settings())
        schedule, batch = settings.schedule, settings.schedule.batch or 1
        drawn = schedule.epochs * job.options.most_frames or schedule.steps * batch
        if job.options.steps:
            drawn = job.options.steps * batch
        # A frame of 12,337 Gaussians takes 50 ms, what goes before the first step 25 s.
        spent = 0.05 * drawn * (0.3 + 0.7 * settings.gaussians / 12_337)
        limit = job.options.seconds
        return 25.0 + (spent if limit is None else min(spent, limit))


class Place(Stage):
    """The avatar in its folder; its description comes last and makes it one."""

    name, title, makes = "place", "Placing the avatar", "avatar"

    def facts(self, job: VideoJob) -> dict[str, str]:
        return {"avatar": avatar_digest(job.fitted)}

    def run(self, job: VideoJob) -> None:
        try:
            for name in (DESCRIPTION, CALL):  # The call is that of another avatar.
                (job.folder / name).unlink(missing_ok=True)
            shutil.rmtree(job.folder / WEIGHTS, ignore_errors=True)
            if (job.fitted / WEIGHTS).is_dir():
                shutil.copytree(job.fitted / WEIGHTS, job.folder / WEIGHTS)
            for name in (MODEL, DESCRIPTION):
                partial = job.folder / f".{name}.partial"
                shutil.copyfile(job.fitted / name, partial)
                os.replace(partial, job.folder / name)
        except OSError as error:
            raise HwpError(f"cannot be written ({reason_of(error)})", where=job.folder) from error

    def expected(self, job: VideoJob) -> float:
        return 0.1


#: Version of the verdict, which the sheet shows too.
VERDICT = 2
#: The stages of a job, in order. Another one is another line here.
STAGES: tuple[Stage, ...] = (
    TrackStage(),
    Import(),
    FitStage(),
    Place(),
    Picture(
        "turntable",
        "Drawing the turntable",
        str((3, SIZE, FRAMES, FPS, BACKGROUND)),
        4.0 + 0.1 * FRAMES,
        draw_turntable,
    ),
    Picture("verdict", "Judging the avatar", str(VERDICT), 6.0, write_verdict),
    Picture(
        "sheet", "Drawing the contact sheet", str((3, COLUMNS, EDGE, VERDICT)), 6.0, draw_sheet
    ),
    Picture("page", "Writing the page", "2", 15.0, write_avatar_page),
)
