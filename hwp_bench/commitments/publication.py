"""Public and sealed parts of captures: what authors get, what scores them, and what binds both.

The public part has no test frame and no truth. Its manifest holds commitments, the sealed part the
salt. Without the salt nobody can test a guess of the hidden content; with it anybody can check,
once the sealed part is opened, that it was not changed after the publication.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadCapture, BadInput, UsageError
from hwp_bench.base.files import (
    atomic_folder,
    canonical_json,
    read_json,
    refuse_existing,
    write_json,
)
from hwp_bench.base.images import pixel_digest
from hwp_bench.base.packages import __version__
from hwp_bench.base.records import Line, Record, parse_record, without_schema
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import refuse_changed
from hwp_bench.capture.schema import (
    CAMERAS,
    FREE_VIEW,
    HANDS,
    IMAGE_FOLDERS,
    METADATA,
    TRUE_HANDS,
    check_id,
)
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.request import write_request
from hwp_bench.metrics.pixels import unscorable

#: Version of the commitments.
SCHEME = "hwp-commitment/1"
#: Length of a salt in bytes: too long to be guessed.
SALT_BYTES = 32
#: Version of the public manifest.
PUBLIC_SCHEMA = "hwp-public/1"
#: Version of the sealed part's key file.
SEALED_SCHEMA = "hwp-sealed/1"
#: Names inside the folder of a publication.
PUBLIC, SEALED, MANIFEST, KEY = "public", "sealed", "manifest.json", "sealed.json"


def target_content(capture: Capture, split: Split) -> dict[str, Any]:
    """Describe by digests the truth that test frames are scored against.

    Returns JSON: id, split digest, and for every test frame the SHA-256 of its decoded pixels and
    of its scoring mask, with whether the mask is exact coverage. The same of the free-view clip,
    where there is one.
    """
    frames = _frame_digests(capture, split.test.tolist())
    content = {"id": capture.info.id, "split": split.digest, "frames": frames}
    clip = capture.free_view
    if clip is not None:
        content["free_view"] = _frame_digests(clip, range(len(clip)))
    return content


def _frame_digests(capture: Capture, frames: Iterable[int]) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for frame in frames:
        mask, exact = capture.scoring_mask(frame)
        rows.append([frame, pixel_digest(capture.frame(frame)), pixel_digest(mask), exact])
    return rows


def commitment(content: Mapping[str, Any], salt: str) -> str:
    """Return the SHA-256 (hex) of a salted content."""
    text = f"{SCHEME}\n{salt}\n{canonical_json(dict(content))}"
    return hashlib.sha256(text.encode()).hexdigest()


def joint_commitment(commitments: Sequence[str]) -> str:
    """Return one digest (hex) of the commitments of all captures, in the manifest's order."""
    return hashlib.sha256("\n".join([SCHEME, *commitments]).encode()).hexdigest()


@dataclass(frozen=True)
class Publication:
    """The parts that were written."""

    #: Folder of the public part, for authors.
    public: Path
    #: Folder of the sealed part, for the keeper.
    sealed: Path
    #: Digest of all commitments (hex), as the public manifest holds it.
    commitment: str
    captures: tuple[str, ...]


def publish(
    captures: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    splits: Mapping[str, Split] | None = None,
    salt: str | None = None,
    describe: Callable[[Path, str], None] | None = None,
) -> Publication:
    """Divide captures into a part for authors and a part that scores their submissions.

    The public part holds a request folder for each capture (what a method sees: training and
    validation frames and masks, and the parameters and cameras of every frame) and a manifest
    with the splits and commitments. The sealed part holds the captures without their `extra/`, with
    their free-view clips; the public part has no picture of these.
    """
    if not captures:
        raise UsageError("no capture is given", field="CAPTURES")
    refuse_existing(out)
    salt = salt or secrets.token_hex(SALT_BYTES)
    pairs = open_captures(captures, splits)
    for capture, split in pairs:
        _refuse_unscorable(capture, split.test.tolist())
        if capture.free_view is not None:
            _refuse_unscorable(capture.free_view, range(len(capture.free_view)))
    commitments = [commitment(target_content(*pair), salt) for pair in pairs]
    with atomic_folder(out) as root:
        # From the start: a process that is killed leaves the folder as it is.
        (root / SEALED).mkdir(mode=0o700)
        for capture, split in pairs:
            name = capture.info.id
            write_request(root / PUBLIC / name, _without_place(capture), split, RunSettings({}))
            _copy_sealed(capture, root / SEALED / name)
        entries = [
            {"id": capture.info.id, "split": split.to_json(), "commitment": committed}
            for (capture, split), committed in zip(pairs, commitments, strict=True)
        ]
        joint = joint_commitment(commitments)
        common = {"toolkit": __version__, "commitment": joint, "captures": entries}
        write_json(root / PUBLIC / MANIFEST, {"schema": PUBLIC_SCHEMA, **common})
        write_json(root / SEALED / KEY, {"schema": SEALED_SCHEMA, "salt": salt, **common})
        if describe is not None:
            describe(root / PUBLIC, joint)
    folder = Path(out)
    return Publication(
        folder / PUBLIC, folder / SEALED, joint, tuple(capture.info.id for capture, _ in pairs)
    )


def _refuse_unscorable(capture: Capture, frames: Iterable[int]) -> None:
    """Refuse, before the commitment, a capture that no evaluation would take after it."""
    refuse_changed(capture, ("frames", "masks", *["true_masks"] * capture.has_true_masks))
    for frame in unscorable(frames, capture.scoring_mask):
        problem = f"the mask of frame {frame} leaves no pixel to score"
        raise BadCapture(problem, where=capture.root, field="masks")


def open_captures(
    paths: Sequence[str | os.PathLike[str]], splits: Mapping[str, Split] | None = None
) -> list[tuple[Capture, Split]]:
    """Open captures, each with its split; no two have one id."""
    opened: list[tuple[Capture, Split]] = []
    for path in paths:
        capture = open_capture(path)
        if any(other.info.id == capture.info.id for other, _ in opened):
            raise BadCapture(
                f"another capture has the id {capture.info.id!r} too",
                where=path,
                field="id",
                remedy="Take them one by one, each into its own folder.",
            )
        opened.append((capture, split_for(capture.info.id, len(capture), splits)))
    return opened


def _without_place(capture: Capture) -> Capture:
    """The capture with a hand model that names no folder of this machine."""
    model = capture.info.hand_model
    kind = re.sub(r":.*", ":MANO_DIR", model.source, flags=re.DOTALL)
    info = replace(capture.info, hand_model=replace(model, source=kind))
    return Capture(capture.root, info, capture.hands, capture.cameras)


def _copy_sealed(capture: Capture, target: Path) -> None:
    target.mkdir(parents=True)
    for name in (METADATA, HANDS, CAMERAS, TRUE_HANDS):
        if (capture.root / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(capture.root / name, target / name)
    for folder in IMAGE_FOLDERS.values():
        if (capture.root / folder).is_dir():
            shutil.copytree(capture.root / folder, target / folder, copy_function=shutil.copyfile)
    clip = capture.free_view
    if clip is not None:
        _copy_sealed(clip, target / FREE_VIEW)


@dataclass(frozen=True)
class SealedPart:
    """A sealed part whose content matches its commitments."""

    #: Capture folders, in the manifest's order.
    captures: tuple[Path, ...]
    #: By capture id.
    splits: Mapping[str, Split]
    #: Digest of all commitments (hex); equal to the public manifest's.
    commitment: str


def open_sealed(path: str | os.PathLike[str]) -> SealedPart:
    """Open a sealed part; every test frame and mask is read and compared."""
    root = Path(path)
    root = root / "sealed" if (root / "sealed" / KEY).is_file() else root
    key = root / KEY
    record = _read(key, SEALED_SCHEMA, _SealedKey)
    splits = {}
    for entry in record.captures:
        name, split = entry.id, Split.from_json(entry.split, where=os.fspath(key))
        check_id(name, os.fspath(key))
        capture = open_capture(root / name)
        if capture.info.id != name or split.capture != name or len(capture) != split.frame_count:
            raise BadInput("split and capture do not belong together", where=key, field=name)
        if commitment(target_content(capture, split), record.salt) != entry.commitment:
            raise BadInput(
                "is not what was committed to: its test frames, masks, split or salt were changed",
                where=key,
                field=name,
                remedy="Get the sealed part again from its keeper.",
            )
        splits[name] = split
    joint = joint_commitment([entry.commitment for entry in record.captures])
    if record.commitment != joint:
        raise BadInput("does not match the captures", where=key, field="commitment")
    public = root.parent / "public" / MANIFEST
    if public.is_file() and _read(public, PUBLIC_SCHEMA, PublicManifest).commitment != joint:
        raise BadInput(
            "publishes a commitment that is not this sealed part's",
            where=public,
            field="commitment",
            remedy="The two parts belong to different publications, or one of them was changed.",
        )
    return SealedPart(tuple(root / name for name in splits), splits, joint)


def read_manifest(public: str | os.PathLike[str]) -> PublicManifest:
    """Read the manifest of a public part."""
    path = Path(public) / MANIFEST
    found = _read(path, PUBLIC_SCHEMA, PublicManifest)
    if joint_commitment([entry.commitment for entry in found.captures]) != found.commitment:
        raise BadInput("does not follow from the captures", where=path, field="commitment")
    return found


@dataclass(frozen=True)
class CommittedCapture:
    """One capture in a manifest or a sealed part's key file."""

    id: Line
    #: `Split.from_json` checks it.
    split: Any
    #: SHA-256 that binds its test frames, masks and split.
    commitment: Line


@dataclass(frozen=True)
class PublicManifest:
    """The fields of a public manifest that are compared."""

    #: Digest of all commitments.
    commitment: Line
    captures: Annotated[list[CommittedCapture], Meta(min_length=1)]


@dataclass(frozen=True)
class _SealedKey(PublicManifest):
    """The fields of a sealed part's key file."""

    #: Hex.
    salt: Annotated[str, Meta(min_length=2 * SALT_BYTES, max_length=10_000)]


def _read(path: Path, schema: str, kind: type[Record]) -> Record:
    value = without_schema(read_json(path), schema, where=path, error=BadInput)
    return parse_record(kind, value, where=path, error=BadInput, ignore_unknown=True)
