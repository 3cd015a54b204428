"""Open a sealed part and check it against its commitments."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json
from hwp_bench.base.records import Line, Record, parse_record, without_schema
from hwp_bench.capture import open_capture
from hwp_bench.capture.schema import check_id
from hwp_bench.capture.splits import Split
from hwp_bench.publish.commitment import SALT_BYTES, commitment, joint_commitment, target_content
from hwp_bench.publish.parts import KEY, MANIFEST, PUBLIC_SCHEMA, SEALED_SCHEMA


@dataclass(frozen=True)
class SealedPart:
    """A sealed part whose content matches its commitments."""

    #: Capture folders, in the manifest's order.
    captures: tuple[Path, ...]
    #: Splits by capture id.
    splits: Mapping[str, Split]
    #: Digest of all commitments (hex); equal to the public manifest's.
    commitment: str


def open_sealed(
    path: str | os.PathLike[str], manifest: str | os.PathLike[str] | None = None
) -> SealedPart:
    """Open a sealed part; every test frame and mask is read and compared.

    Args:
        path: the folder `sealed`, or the publication that holds it.
        manifest: the public manifest (or its folder) to compare with; None takes the one next
            to the sealed part, if there is one.

    Returns:
        Captures and splits to score submissions with.

    Raises:
        BadInput: it is not a sealed part, or its content, its key and the public manifest
            contradict each other; the capture is named.
    """
    root = Path(path)
    root = root / "sealed" if (root / "sealed" / KEY).is_file() else root
    key = root / KEY
    record = _read(key, SEALED_SCHEMA, _SealedKey)
    captures, splits, commitments = [], {}, []
    for entry in record.captures:
        name, split = entry.id, Split.from_json(entry.split, where=os.fspath(key))
        check_id(name, os.fspath(key))
        capture = open_capture(root / name)
        if capture.info.id != name or split.capture != name or len(capture) != split.frame_count:
            raise BadInput("split and capture do not belong together", where=key, field=name)
        committed = commitment(target_content(capture, split), record.salt)
        if committed != entry.commitment:
            raise BadInput(
                "is not what was committed to: its test frames, masks, split or salt were changed",
                where=key,
                field=name,
                remedy="Get the sealed part again from its keeper.",
            )
        captures.append(root / name)
        splits[name] = split
        commitments.append(committed)
    joint = joint_commitment(commitments)
    if record.commitment != joint:
        raise BadInput("does not match the captures", where=key, field="commitment")
    _compare_public(root, manifest, joint)
    return SealedPart(tuple(captures), splits, joint)


def _compare_public(root: Path, manifest: str | os.PathLike[str] | None, joint: str) -> None:
    default = root.parent / "public" / MANIFEST
    if manifest is None and not default.is_file():
        return
    path = default if manifest is None else Path(manifest)
    path = path / MANIFEST if path.is_dir() else path
    if _read(path, PUBLIC_SCHEMA, PublicManifest).commitment != joint:
        raise BadInput(
            "publishes a commitment that is not this sealed part's",
            where=path,
            field="commitment",
            remedy="The two parts belong to different publications, or one of them was changed.",
        )


def read_manifest(public: str | os.PathLike[str]) -> PublicManifest:
    """Read the manifest of a public part.

    Raises:
        BadInput: it is damaged, or its commitments do not make the joint one.
    """
    path = Path(public) / MANIFEST
    found = _read(path, PUBLIC_SCHEMA, PublicManifest)
    if joint_commitment([entry.commitment for entry in found.captures]) != found.commitment:
        raise BadInput("does not follow from the captures", where=path, field="commitment")
    return found


def _read(path: Path, schema: str, kind: type[Record]) -> Record:
    value = without_schema(read_json(path), schema, where=path, error=BadInput)
    return parse_record(kind, value, where=path, error=BadInput, ignore_unknown=True)


@dataclass(frozen=True)
class CommittedCapture:
    """One capture in a manifest or a sealed part's key file."""

    #: Its id.
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
    #: The captures.
    captures: Annotated[list[CommittedCapture], Meta(min_length=1)]


@dataclass(frozen=True)
class _SealedKey:
    """The fields of a sealed part's key file."""

    salt: Annotated[str, Meta(min_length=2 * SALT_BYTES, max_length=10_000)]
    commitment: Line
    captures: Annotated[list[CommittedCapture], Meta(min_length=1)]
