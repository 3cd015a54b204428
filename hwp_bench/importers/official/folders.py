"""Folders of the release: their captures, the subsampling, and where the files are."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput
from hwp_bench.taxonomy import catalogue

_NAME = re.compile(r"(capture\d+)(?:_subsample(\d+))?(_single)?")
_SEPARATORS = re.compile(r"[\\/]+")


@dataclass(frozen=True)
class OfficialFolder:
    """One folder of the release."""

    #: The folder.
    path: Path
    #: Its pickles (`output*.pkl`), in the order of their names; together they are one capture.
    pickles: tuple[Path, ...]
    #: Id of the capture, a key of the catalogue where the folder's name contains one.
    id: str
    #: Step between the frames that were kept of the video, or None where the name has none.
    subsample: int | None
    #: Whether one hand was tracked, according to the name.
    single: bool


def find_folders(
    path: str | os.PathLike[str], identifier: str | None = None
) -> list[OfficialFolder]:
    """Find the captures of a folder: itself, or its subfolders down to the third level.

    Args:
        path: a folder with `output.pkl`, or one that contains such folders, as a download does.
        identifier: id of the capture where the folder has no name of the release.

    Raises:
        BadInput: the folder is missing, it contains no pickle, a name is not of the release, or
            two folders are of one capture.
    """
    root = Path(path)
    if not root.is_dir():
        raise BadInput("is not a folder", where=root)
    deeper = ("*", "*/*", "*/*/*")
    below = sorted({file.parent for level in deeper for file in root.glob(f"{level}/output*.pkl")})
    candidates = [root] if _pickles(root) else below
    if not candidates:
        raise BadInput(
            "contains no output.pkl, also not in its subfolders",
            where=root,
            remedy="Give a folder of the release, such as capture0_subsample3_single.",
        )
    if identifier is not None and len(candidates) > 1:
        raise BadInput("holds several captures, which cannot have one id", where=root, field="--id")
    folders = [_folder(candidate, identifier) for candidate in candidates]
    for index, folder in enumerate(folders):
        for other in folders[:index]:
            if other.id == folder.id:
                raise BadInput(
                    f"holds {folder.id} twice: {other.path.name} and {folder.path.name}",
                    where=root,
                    remedy="Import them one by one.",
                )
    return folders


def _pickles(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(folder.glob("output*.pkl")))


def _folder(path: Path, identifier: str | None) -> OfficialFolder:
    name = path.absolute().name
    match = _NAME.fullmatch(name)
    if identifier is None and (match is None or match.group(1) not in catalogue()):
        raise BadInput(
            f"{name!r} is not a name of the release (captureN_subsampleK, N from 0 to 10, "
            "for one hand with _single)",
            where=path,
            remedy="Name the capture with --id.",
        )
    return OfficialFolder(
        path=path,
        pickles=_pickles(path),
        id=identifier or (match.group(1) if match else name),
        subsample=int(match.group(2)) if match and match.group(2) else None,
        single=bool(match and match.group(3)),
    )


def find_file(folder: Path, named: str, *, where: Path, field: str) -> Path:
    """Find a file that a pickle names, only in the pickle's own folder.

    The paths in the release belong to its authors' machine. The last parts of the name are
    searched for below the folder, the bare file name first. No name can lead out of the folder.

    Raises:
        BadInput: the file does not exist.
    """
    parts = [part for part in _SEPARATORS.split(named) if part not in ("", ".", "..")]
    for count in range(1, len(parts) + 1):
        candidate = folder.joinpath(*parts[-count:])
        if candidate.is_file():
            return candidate
    raise BadInput(
        f"names {named[-80:]!r}, which is not in {folder}",
        where=where,
        field=field,
        remedy="Put the images and masks of the release next to its pickle.",
    )
