"""Look at a capture: is its content what its digests say, what is wrong, a contact sheet."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, outlined, sheet
from hwp_bench.base.errors import BadCapture, BadHandModel, HwpError, UsageError, bounded, shown
from hwp_bench.base.images import is_blank, pixel_digest
from hwp_bench.capture.reader import Capture, open_capture
from hwp_bench.capture.schema import (
    HANDS,
    IMAGE_FOLDERS,
    METADATA,
    SIMULATED,
    TRUE_HANDS,
    CaptureInfo,
    arrays_digest,
    hand_arrays,
    image_path,
)
from hwp_bench.capture.writer import combine
from hwp_bench.hands.template import HandTemplate
from hwp_bench.taxonomy import perturbation


def refuse_changed(capture: Capture, kinds: Iterable[str] = ("frames", "masks")) -> None:
    """Refuse a capture whose images or numbers are not those of its digests.

    A score stands under the digest of its capture, so that the pixels behind it must be those.
    Every image of the kinds is decoded: about 2 ms for a frame of 256 x 256 px.

    Args:
        capture: the capture.
        kinds: images that are looked at, keys of `IMAGE_FOLDERS`; estimated hand parameters and
            cameras always are.

    Raises:
        BadImage: an image is missing or damaged.
        BadCapture: a part was changed after the capture was written; it is named.
    """
    found = {
        "hands": arrays_digest(hand_arrays(capture.hands)),
        "cameras": arrays_digest({"Ks": capture.cameras.Ks, "viewmats": capture.cameras.viewmats}),
        **{kind: images_digest(capture, kind) for kind in kinds},
    }
    stored = capture.info.digests or {}
    for part, digest in found.items():
        if stored.get(part) != digest:
            raise BadCapture(
                "does not match the content" if part in stored else "is missing",
                where=capture.root / METADATA,
                field=f"digests.{part}",
                remedy="The content was changed after the capture was written; get it again.",
            )


def images_digest(capture: Capture, kind: str) -> str:
    """Return the digest over the decoded images of one kind.

    Args:
        capture: the capture.
        kind: a key of `IMAGE_FOLDERS`.

    Raises:
        BadImage: an image is missing or damaged.
    """
    read = image_reader(capture, kind)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        return combine(pool.map(lambda frame: pixel_digest(read(frame)), range(len(capture))))


def image_reader(capture: Capture, kind: str) -> Callable[[int], np.ndarray]:
    """Return the function that reads one image of a kind, a key of `IMAGE_FOLDERS`, by frame."""
    return {
        "frames": capture.frame,
        "masks": capture.mask,
        "clean": capture.clean,
        "true_masks": capture.true_mask,
        "clean_masks": capture.clean_mask,
    }[kind]


#: A visible hand smaller than this share of the frame is reported.
SMALL_HAND = 0.002
#: A hand that is valid in a smaller share of the frames than this is reported.
FEW_VALID = 0.5
#: Most warnings of an import that are repeated, and most characters of each.
MOST_WARNINGS, MAX_TEXT = 20, 1000
#: Faces of a hand template that are smaller than this are reported, in square metres.
SMALL_FACE = 1e-12


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong (`error`) or worth a look (`warning`)."""

    #: `error` or `warning`.
    level: str
    #: File or folder.
    where: str
    #: Field or array in it, if any.
    field: str | None
    #: What is wrong.
    problem: str
    #: What to do.
    remedy: str | None = None


@dataclass(frozen=True)
class CheckReport:
    """Findings of `check_capture`."""

    #: The folder.
    path: str
    #: Facts about the capture, empty when it could not be opened.
    facts: dict[str, Any]
    #: Everything found, errors first.
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong (warnings do not count)."""
        return not any(finding.level == "error" for finding in self.findings)


def check_capture(path: str | os.PathLike[str]) -> CheckReport:
    """Check a capture: metadata, numbers, every image, geometry, hand model, digests.

    Faults of the capture are not raised: they all go into the report.
    """
    try:
        capture = open_capture(path)
    except HwpError as error:
        return CheckReport(os.fspath(path), {}, (_finding(error),))
    findings = [
        *_import(capture),
        *_valid(capture),
        *_images(capture),
        *_geometry(capture),
        *_templates(capture),
        *_numbers(capture),
        *_missing_truth(capture),
        *_free_view(capture),
    ]
    findings.sort(key=lambda finding: finding.level)
    return CheckReport(os.fspath(path), _facts(capture), tuple(findings))


def _finding(error: HwpError) -> Finding:
    return Finding("error", error.where or "", error.field, error.problem, error.remedy)


def _facts(capture: Capture) -> dict[str, Any]:
    info = capture.info
    return {
        "id": info.id,
        "hands": info.hands,
        "action": info.action,
        "device": info.device,
        "frame_count": info.frame_count,
        "size": [info.width, info.height],
        "fps": info.fps,
        "hand_model": info.hand_model.name,
        "made_by": info.made_by or "not stated",
        "perturbed_frames": _perturbed_frames(info),
        "valid_frames": {side: int(hand.valid.sum()) for side, hand in capture.hands.items()},
        "truth": [
            name
            for name, present in (
                ("clean frames", capture.has_clean),
                ("exact masks", capture.has_true_masks),
                ("hand parameters", capture.true_hands is not None),
            )
            if present
        ],
        "free_view_frames": _count(capture),
        "licence": info.licence,
        "digest": capture.digest,
    }


def _perturbed_frames(info: CaptureInfo) -> dict[str, int | None] | None:
    """Frames by perturbation, None where it is not known in which; None where nothing is known.

    A simulated capture declares all that acts. An import that declares nothing was not judged.
    """
    if not info.perturbations and info.source.get("kind") != SIMULATED:
        return None
    return {
        name: None if values is None else sum(value > 0 for value in values)
        for name, values in info.perturbations.items()
    }


def _count(capture: Capture) -> int:
    """Frames of the free-view clip; 0 where there is none that can be opened."""
    try:
        return 0 if capture.free_view is None else len(capture.free_view)
    except HwpError:  # reported as a finding
        return 0


def _free_view(capture: Capture) -> tuple[Finding, ...]:
    """Everything about the clip, which is a capture of its own."""
    try:
        clip = capture.free_view
    except HwpError as error:
        return (_finding(error),)
    return () if clip is None else check_capture(clip.root).findings


def _import(capture: Capture) -> Iterator[Finding]:
    """Warnings of the importer of a video, as its record keeps them."""
    record = capture.info.source.get("fit")
    warnings = record.get("warnings") if isinstance(record, dict) else None
    for warning in warnings[:MOST_WARNINGS] if isinstance(warnings, list) else ():
        yield Finding(
            "warning",
            os.fspath(capture.root / METADATA),
            "source.fit.warnings",
            shown(str(warning))[:MAX_TEXT],
            "Look at extra/overlay.png; correct the landmarks and import again.",
        )


def _valid(capture: Capture) -> Iterator[Finding]:
    """Hands whose parameters are valid in few frames, or in none."""
    where = os.fspath(capture.root / HANDS)
    counts = {side: int(hand.valid.sum()) for side, hand in capture.hands.items()}
    for side, count in counts.items():
        said = f"the {side} hand is valid in {count} of {len(capture)} frames"
        if not any(counts.values()):
            yield Finding("error", where, f"{side}_valid", said, "There is nothing to be fitted.")
        elif count < FEW_VALID * len(capture):
            remedy = "Only they are fitted; look whether they follow the hand."
            yield Finding("warning", where, f"{side}_valid", said, remedy)


def _images(capture: Capture) -> Iterator[Finding]:
    for kind in IMAGE_FOLDERS:
        folder = capture.root / IMAGE_FOLDERS[kind]
        if kind not in ("frames", "masks") and not folder.is_dir():
            continue
        yield from _one_kind(capture, kind, folder)


def _one_kind(capture: Capture, kind: str, folder: Path) -> Iterator[Finding]:
    read = image_reader(capture, kind)

    def inspect(frame: int) -> tuple[str | None, Finding | None]:
        try:
            pixels = read(frame)
        except HwpError as error:
            return None, _finding(error)
        finding = None
        if kind == "masks" and (pixels > 127).mean() < SMALL_HAND:
            finding = Finding(
                "warning",
                os.fspath(image_path(capture.root, kind, frame)),
                None,
                f"covers {100 * (pixels > 127).mean():.2f} % of the frame",
                "A frame without a visible hand teaches a method nothing.",
            )
        if kind == "frames" and is_blank(pixels):
            finding = Finding(
                "warning",
                os.fspath(image_path(capture.root, kind, frame)),
                None,
                f"is of one colour (mean level {pixels.mean():.0f})",
                "It shows no hand; leave such frames out of the capture.",
            )
        return pixel_digest(pixels), finding

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        results = list(pool.map(inspect, range(len(capture))))
    yield from (finding for _, finding in results if finding is not None)
    known = {image_path(capture.root, kind, frame).name for frame in range(len(capture))}
    present = {item.name for item in folder.iterdir()} if folder.is_dir() else set()
    others = sorted(present - known)
    if others:
        yield Finding(
            "warning",
            os.fspath(folder),
            None,
            f"holds {len(others)} further files: {shown(bounded(others))}",
            "They are ignored.",
        )
    digests = [digest for digest, _ in results]
    if all(digests):
        yield from _compare(capture, kind, combine(digest for digest in digests if digest))


def _compare(capture: Capture, part: str, digest: str) -> Iterator[Finding]:
    stored = (capture.info.digests or {}).get(part)
    if stored != digest:
        yield Finding(
            "error",
            os.fspath(capture.root / "capture.json"),
            f"digests.{part}",
            "does not match the content" if stored else "is missing",
            "The content was changed after the capture was written; get it again.",
        )


def _geometry(capture: Capture) -> Iterator[Finding]:
    for side, hand in capture.hands.items():
        points = np.concatenate([hand.transl, np.ones((len(hand.transl), 1))], axis=1)
        depth = np.einsum("fi,fi->f", capture.cameras.viewmats[:, 2], points)
        behind = np.flatnonzero((depth <= 0) & hand.valid)
        if len(behind):
            yield Finding(
                "error",
                os.fspath(capture.root / "hands.npz"),
                f"{side}_transl",
                f"the hand lies behind the camera in {len(behind)} of {len(hand.valid)} frames: "
                f"{bounded(behind.tolist())}",
                "Mark such frames as not valid, or correct the translation.",
            )


def _templates(capture: Capture) -> Iterator[Finding]:
    for side in capture.info.sides:
        try:
            template = capture.template(side)
        except BadCapture as error:
            yield _finding(error)
            return
        except (BadHandModel, UsageError):
            continue  # not installed here, as MANO often is: commands that need it say so
        except HwpError as error:
            # Nothing of the capture is wrong, but no method here takes it.
            yield replace(_finding(error), level="warning")
            return
        for problem in mesh_problems(template):
            yield Finding(
                "warning",
                os.fspath(capture.root / "capture.json"),
                "hand_model",
                f"the {side} template {problem}",
                "Projections and renderings of it can be wrong; get the hand model again.",
            )


def mesh_problems(template: HandTemplate) -> list[str]:
    """Return what is wrong with the mesh of a hand template; empty where nothing is.

    A sound template has one opening (the wrist), no face without an area, and faces that all turn
    the same way, counterclockwise seen from outside.
    """
    import trimesh

    mesh = trimesh.Trimesh(template.vertices, template.faces, process=False)
    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    openings = len(trimesh.graph.connected_components(edges))
    empty = int((mesh.area_faces < SMALL_FACE).sum())
    problems = []
    if openings != 1:
        problems.append(f"has {openings} openings where only the wrist is open")
    if empty:
        problems.append(f"has {empty} faces without an area")
    if not mesh.is_winding_consistent:
        problems.append("has faces that turn in different directions")
    elif mesh.volume < 0:
        problems.append("is turned inside out")
    return problems


def _missing_truth(capture: Capture) -> Iterator[Finding]:
    """Truth that the digests list and the folder lacks, as a copy without it does."""
    listed = capture.info.digests or {}
    places = {kind: capture.root / folder for kind, folder in IMAGE_FOLDERS.items()}
    places["true_hands"] = capture.root / TRUE_HANDS
    for kind, place in places.items():
        if kind in ("frames", "masks") or kind not in listed or place.exists():
            continue
        scored = "Scores are taken over the estimated masks, and the digest says so; results do "
        scored += "not compare with those of the whole capture."
        yield Finding(
            "warning",
            os.fspath(capture.root / METADATA),
            f"digests.{kind}",
            f"lists {place.relative_to(capture.root)}, which is not there",
            scored if kind == "true_masks" else "What needs this truth is refused.",
        )


def _numbers(capture: Capture) -> Iterator[Finding]:
    yield from _compare(capture, "hands", arrays_digest(hand_arrays(capture.hands)))
    cameras = {"Ks": capture.cameras.Ks, "viewmats": capture.cameras.viewmats}
    yield from _compare(capture, "cameras", arrays_digest(cameras))
    try:
        truth = capture.true_hands
    except HwpError as error:
        yield _finding(error)
        return
    if truth is not None:
        yield from _compare(capture, "true_hands", arrays_digest(hand_arrays(truth)))


#: Colour of the projected hand, by side.
COLOURS = {"right": (255, 160, 0), "left": (0, 170, 255)}
#: The 20 bones between the 21 landmarks: wrist to each finger's base, then outwards.
BONES = tuple(
    (0 if joint == 0 else 4 * finger + joint, 4 * finger + joint + 1)
    for finger in range(5)
    for joint in range(4)
)


def contact_sheet(capture: Capture, *, count: int = 24, edge: int = 256) -> np.ndarray:
    """Draw frames of a capture, evenly spaced, each with its mask and hands.

    Args:
        capture: the capture.
        count: number of frames.
        edge: larger side of a frame on the sheet, px.

    Returns:
        (H, W, 3) uint8. Green outline: the mask that methods are given; coloured skeleton: the
        estimated hand (orange right, blue left), left out where it is not valid.
    """
    chosen = evenly(len(capture), count).tolist()
    tiles = [
        labelled(
            fitted(draw_hands(outlined(capture.frame(f), capture.mask(f)), points), edge),
            _caption(capture, f),
        )
        for f, points in zip(chosen, project_landmarks(capture, chosen), strict=True)
    ]
    return sheet(tiles, columns=6)


def project_landmarks(capture: Capture, frames: list[int]) -> Iterator[dict[str, np.ndarray]]:
    """Yield, for each frame, the projected landmarks (21, 2) px of every valid hand, by side."""
    import torch

    from hwp_bench.hands import load_template, pose_hand, project

    Ks = torch.from_numpy(capture.cameras.Ks[frames])
    viewmats = torch.from_numpy(capture.cameras.viewmats[frames])
    pixels: dict[str, np.ndarray] = {}
    for side, hand in capture.hands.items():
        tensors = load_template(capture.info.hand_model.source, side).to_torch(torch.float64)
        posed = pose_hand(
            tensors,
            torch.from_numpy(hand.pose[frames]),
            torch.from_numpy(hand.betas).expand(len(frames), -1),
            torch.from_numpy(hand.transl[frames]),
        )
        pixels[side] = project(posed.landmarks, viewmats, Ks)[0].numpy()
    for index, frame in enumerate(frames):
        yield {
            side: points[index]
            for side, points in pixels.items()
            if capture.hands[side].valid[frame]
        }


def draw_hands(image: np.ndarray, points: dict[str, np.ndarray]) -> np.ndarray:
    """Draw skeletons into a copy of an image.

    Args:
        image: (H, W, 3) uint8.
        points: (21, 2) px by side, pixel centres at +0.5.
    """
    canvas = image.copy()
    for side, landmarks in points.items():
        # OpenCV counts pixel centres from 0, in fixed point with 3 fractional bits here.
        # Beyond 1e6 it draws nothing anyway; NaN is far off too.
        places = np.nan_to_num((landmarks - 0.5) * 8, nan=1e6)
        spots = np.clip(places, -1e6, 1e6).round().astype(int)
        for first, last in BONES:
            cv2.line(
                canvas,
                tuple(spots[first].tolist()),
                tuple(spots[last].tolist()),
                COLOURS[side],
                1,
                cv2.LINE_AA,
                3,
            )
    return canvas


def _caption(capture: Capture, frame: int) -> str:
    parts = [str(frame)]
    for name, severity in capture.info.severity(frame).items():
        if severity:
            parts.append(f"{perturbation(name).short}{severity}")
    invalid = [side for side, hand in capture.hands.items() if not hand.valid[frame]]
    parts += [f"no {side}" for side in invalid]
    return " ".join(parts)
