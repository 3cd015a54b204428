"""Look at a capture: is its content what its digests say, what is wrong, a contact sheet."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, outlined, sheet
from hwp_bench.base.errors import BadCapture, BadHandModel, HwpError, UsageError, bounded, shown
from hwp_bench.base.images import is_blank, pixel_digest
from hwp_bench.capture.folder import Capture, combine, open_capture
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
    numbers_digests,
)
from hwp_bench.hands.skeleton import draw_bones
from hwp_bench.hands.template import HandTemplate
from hwp_bench.taxonomy import perturbation


def refuse_changed(capture: Capture, kinds: Iterable[str] = ("frames", "masks")) -> None:
    """Refuse a capture whose images or numbers are not those of its digests.

    A score stands under the digest of its capture, so that the pixels behind it must be those.
    Every image of the kinds is decoded: about 2 ms for a frame of 256 x 256 px.
    """
    found = numbers_digests(capture.hands, capture.cameras)
    for kind in kinds:
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            # Digests alone wait for their turn, not decoded images.
            digests = pool.map(partial(_digest, capture, kind), range(len(capture)))
            found[kind] = combine(digests)
    for part, digest in found.items():
        if error := _changed(capture, part, digest):
            raise error


def _digest(capture: Capture, kind: str, frame: int) -> str:
    return pixel_digest(capture.image(kind, frame))


def _changed(capture: Capture, part: str, digest: str) -> BadCapture | None:
    """The fault of the digest that a capture states of a part; None if it is the part's."""
    stored = (capture.info.digests or {}).get(part)
    if stored == digest:
        return None
    return BadCapture(
        "does not match the content" if stored else "is missing",
        where=capture.root / METADATA,
        field=f"digests.{part}",
        remedy="The content was changed after the capture was written; get it again.",
    )


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
    clip: Capture | None = None
    findings = [
        *_import(capture),
        *_valid(capture),
        *(one for kind in IMAGE_FOLDERS for one in _images(capture, kind)),
        *_geometry(capture),
        *_templates(capture),
        *_numbers(capture),
        *_missing_truth(capture),
    ]
    try:
        clip = capture.free_view
    except HwpError as error:
        findings.append(_finding(error))
    if clip is not None:
        # The free-view clip is a capture of its own.
        findings += check_capture(clip.root).findings
    findings.sort(key=lambda finding: finding.level)
    return CheckReport(os.fspath(path), _facts(capture, clip), tuple(findings))


def _finding(error: HwpError) -> Finding:
    return Finding("error", error.where or "", error.field, error.problem, error.remedy)


def _warning(where: Path, field: str | None, problem: str, remedy: str) -> Finding:
    return Finding("warning", os.fspath(where), field, problem, remedy)


def _facts(capture: Capture, clip: Capture | None) -> dict[str, Any]:
    info = capture.info
    truth = {
        "clean frames": capture.has_clean,
        "exact masks": capture.has_true_masks,
        "hand parameters": (capture.root / TRUE_HANDS).is_file(),
    }
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
        "truth": [name for name, present in truth.items() if present],
        "free_view_frames": 0 if clip is None else len(clip),
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


def _import(capture: Capture) -> Iterator[Finding]:
    """Warnings of the importer of a video, as its record keeps them."""
    record = capture.info.source.get("fit")
    warnings = record.get("warnings") if isinstance(record, dict) else None
    remedy = "Look at extra/overlay.png; correct the landmarks and import again."
    for warning in warnings[:MOST_WARNINGS] if isinstance(warnings, list) else ():
        said = shown(str(warning))[:MAX_TEXT]
        yield _warning(capture.root / METADATA, "source.fit.warnings", said, remedy)


def _valid(capture: Capture) -> Iterator[Finding]:
    """Hands whose parameters are valid in few frames, or in none."""
    where = capture.root / HANDS
    counts = {side: int(hand.valid.sum()) for side, hand in capture.hands.items()}
    for side, count in counts.items():
        said, field = (
            f"the {side} hand is valid in {count} of {len(capture)} frames",
            f"{side}_valid",
        )
        if not any(counts.values()):
            remedy = "There is nothing to be fitted."
            yield Finding("error", os.fspath(where), field, said, remedy)
        elif count < FEW_VALID * len(capture):
            remedy = "Only they are fitted; look whether they follow the hand."
            yield _warning(where, field, said, remedy)


def _images(capture: Capture, kind: str) -> Iterator[Finding]:
    """Images of one kind, a key of `IMAGE_FOLDERS`, that cannot be read or show nothing."""
    folder = capture.root / IMAGE_FOLDERS[kind]
    if kind not in ("frames", "masks") and not folder.is_dir():
        return

    def inspect(frame: int) -> tuple[str | None, Finding | None]:
        try:
            pixels = capture.image(kind, frame)
        except HwpError as error:
            return None, _finding(error)
        file, finding = image_path(capture.root, kind, frame), None
        if kind == "masks" and (pixels > 127).mean() < SMALL_HAND:
            said = f"covers {100 * (pixels > 127).mean():.2f} % of the frame"
            remedy = "A frame without a visible hand teaches a method nothing."
            finding = _warning(file, None, said, remedy)
        if kind == "frames" and is_blank(pixels):
            said = f"is of one colour (mean level {pixels.mean():.0f})"
            remedy = "It shows no hand; leave such frames out of the capture."
            finding = _warning(file, None, said, remedy)
        return pixel_digest(pixels), finding

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        results = list(pool.map(inspect, range(len(capture))))
    yield from (finding for _, finding in results if finding is not None)
    known = {image_path(capture.root, kind, frame).name for frame in range(len(capture))}
    others = sorted({item.name for item in folder.iterdir()} - known) if folder.is_dir() else []
    if others:
        said = f"holds {len(others)} further files: {shown(bounded(others))}"
        yield _warning(folder, None, said, "They are ignored.")
    digests = [digest for digest, _ in results if digest]
    if len(digests) == len(results):
        yield from _compare(capture, kind, combine(digests))


def _compare(capture: Capture, part: str, digest: str) -> Iterator[Finding]:
    if error := _changed(capture, part, digest):
        yield _finding(error)


def _geometry(capture: Capture) -> Iterator[Finding]:
    for side, hand in capture.hands.items():
        points = np.concatenate([hand.transl, np.ones((len(hand.transl), 1))], axis=1)
        depth = np.einsum("fi,fi->f", capture.cameras.viewmats[:, 2], points)
        behind = np.flatnonzero((depth <= 0) & hand.valid)
        if len(behind):
            yield Finding(
                "error",
                os.fspath(capture.root / HANDS),
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
        remedy = "Projections and renderings of it can be wrong; get the hand model again."
        for problem in mesh_problems(template):
            said = f"the {side} template {problem}"
            yield _warning(capture.root / METADATA, "hand_model", said, remedy)


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
    for kind, place in {**IMAGE_FOLDERS, "true_hands": TRUE_HANDS}.items():
        if kind in ("frames", "masks") or kind not in listed or (capture.root / place).exists():
            continue
        remedy = "What needs this truth is refused."
        if kind == "true_masks":
            remedy = "Scores are taken over the estimated masks, and the digest says so; results "
            remedy += "do not compare with those of the whole capture."
        said = f"lists {place}, which is not there"
        yield _warning(capture.root / METADATA, f"digests.{kind}", said, remedy)


def _numbers(capture: Capture) -> Iterator[Finding]:
    for part, digest in numbers_digests(capture.hands, capture.cameras).items():
        yield from _compare(capture, part, digest)
    try:
        truth = capture.true_hands
    except HwpError as error:
        yield _finding(error)
        return
    if truth is not None:
        yield from _compare(capture, "true_hands", arrays_digest(hand_arrays(truth)))


#: Colour of the projected hand, by side.
COLOURS = {"right": (255, 160, 0), "left": (0, 170, 255)}


def contact_sheet(capture: Capture, *, count: int = 24, edge: int = 256) -> np.ndarray:
    """Draw frames of a capture, evenly spaced, each with its mask and hands.

    Args:
        edge: larger side of a frame on the sheet, px.

    Returns:
        (H, W, 3) uint8. Green outline: the mask that methods are given; coloured skeleton: the
        estimated hand (orange right, blue left), left out where it is not valid.
    """
    import torch

    from hwp_bench.hands import project
    from hwp_bench.hands.skinning import pose_parameters

    chosen = evenly(len(capture), count).tolist()
    cameras = (capture.cameras.viewmats[chosen], capture.cameras.Ks[chosen])
    pixels: dict[str, np.ndarray] = {}
    for side, hand in capture.hands.items():
        landmarks = pose_parameters(capture.template(side), hand, chosen).landmarks
        pixels[side] = project(landmarks, *map(torch.from_numpy, cameras))[0].numpy()
    tiles = []
    for row, frame in enumerate(chosen):
        seen = {s: places[row] for s, places in pixels.items() if capture.hands[s].valid[frame]}
        drawn = draw_hands(outlined(capture.frame(frame), capture.mask(frame)), seen)
        tiles.append(labelled(fitted(drawn, edge), _caption(capture, frame)))
    return sheet(tiles, columns=6)


def draw_hands(image: np.ndarray, points: dict[str, np.ndarray]) -> np.ndarray:
    """Draw skeletons, (21, 2) px by side, into a copy of an image (H, W, 3) uint8."""
    canvas = image.copy()
    for side, landmarks in points.items():
        draw_bones(canvas, landmarks, COLOURS[side])
    return canvas


def _caption(capture: Capture, frame: int) -> str:
    parts = [str(frame)]
    for name, severity in capture.info.severity(frame).items():
        if severity:
            parts.append(f"{perturbation(name).short}{severity}")
    invalid = [side for side, hand in capture.hands.items() if not hand.valid[frame]]
    parts += [f"no {side}" for side in invalid]
    return " ".join(parts)
