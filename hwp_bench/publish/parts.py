"""Write the public part (no test frame, no truth) and the sealed part of captures."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.base.errors import BadCapture, UsageError
from hwp_bench.base.files import atomic_folder, write_json
from hwp_bench.base.packages import __version__
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.schema import (
    CAMERAS,
    FREE_VIEW,
    HANDS,
    IMAGE_FOLDERS,
    METADATA,
    TRUE_HANDS,
)
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.request import write_request
from hwp_bench.publish.commitment import SALT_BYTES, commitment, joint_commitment, target_content

#: Version of the public manifest.
PUBLIC_SCHEMA = "hwp-public/1"
#: Version of the sealed part's key file.
SEALED_SCHEMA = "hwp-sealed/1"
#: Names inside the folder of a publication.
PUBLIC, SEALED, MANIFEST, KEY = "public", "sealed", "manifest.json", "sealed.json"


@dataclass(frozen=True)
class Publication:
    """The parts that were written."""

    #: Folder of the public part, for authors.
    public: Path
    #: Folder of the sealed part, for the keeper.
    sealed: Path
    #: Digest of all commitments (hex), as the public manifest holds it.
    commitment: str
    #: Ids of the captures.
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

    Args:
        captures: capture folders.
        out: folder to make, with `public/` and `sealed/`.
        splits: splits by capture id; None applies the 80/10/10 rule.
        salt: hex of at least 32 bytes that nobody knows; None draws one.
        describe: writes more into the public part, before it takes its name; gets its folder and
            the joint commitment.

    Returns:
        Where the parts are, and the commitment.

    Raises:
        UsageError: `out` exists, or no capture is given.
        BadCapture, BadImage, BadSplit: a capture is damaged or cannot be split.
    """
    if not captures:
        raise UsageError("no capture is given", field="CAPTURES")
    salt = salt or secrets.token_hex(SALT_BYTES)
    pairs: list[tuple[Capture, Split]] = []
    for path in captures:
        capture = open_capture(path)
        if any(capture.info.id == other.info.id for other, _ in pairs):
            raise BadCapture(
                f"another capture has the id {capture.info.id!r} too", where=path, field="id"
            )
        pairs.append((capture, split_for(capture.info.id, len(capture), splits)))
    contents = [target_content(capture, split) for capture, split in pairs]
    commitments = [commitment(content, salt) for content in contents]
    with atomic_folder(out) as root:
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
        os.chmod(root / SEALED, 0o700)
    folder = Path(out)
    return Publication(
        folder / PUBLIC, folder / SEALED, joint, tuple(capture.info.id for capture, _ in pairs)
    )


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
