"""Download the official release from the Hugging Face hub: resumable, pinned, never overwriting."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import cache_root, inside, read_json, sha256_file, write_json
from hwp_bench.base.packages import import_extra

#: The release, a data set on the hub.
REPOSITORY = "XuanHuang0/WildGHand"
#: Name of the record in a download folder.
RECORD = "hwp-download.json"
#: Version of the record and of the pins.
SCHEMA = "hwp-download/1"
#: Endings of archives, which are fetched and left packed.
ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".7z", ".rar")


@dataclass(frozen=True)
class RemoteFile:
    """One file of the release."""

    #: Path inside the repository.
    name: str
    #: Bytes, or None where the hub does not state it.
    size: int | None
    #: SHA-256 (hex) that the hub states for large files, or None.
    sha256: str | None


@dataclass(frozen=True)
class Download:
    """The result of a download."""

    #: The folder.
    folder: Path
    #: Commit of the repository.
    commit: str
    #: SHA-256 (hex) by file name.
    files: dict[str, str]
    #: How many of them existed already.
    kept: int
    #: Archives among them.
    archives: tuple[str, ...]


class HuggingFaceHub:
    """The hub through `huggingface_hub`."""

    def __init__(self) -> None:
        problem = "huggingface_hub is not installed; the release can be downloaded by hand, too"
        self._hub = import_extra("huggingface_hub", "hub", problem)

    def files(self, revision: str | None) -> tuple[str, list[RemoteFile]]:
        """Return the commit that a revision names, and its files."""
        info = self._hub.HfApi().dataset_info(REPOSITORY, revision=revision, files_metadata=True)
        files = []
        for item in info.siblings or []:
            stated = getattr(item, "lfs", None)
            digest = getattr(stated, "sha256", None)
            if digest is None and isinstance(stated, dict):
                digest = stated.get("sha256")
            files.append(RemoteFile(item.rfilename, getattr(item, "size", None), digest))
        return str(info.sha), files

    def fetch(self, name: str, commit: str, folder: Path) -> Path:
        """Download one file below a folder, continuing where an earlier try stopped."""
        return Path(
            self._hub.hf_hub_download(
                REPOSITORY,
                name,
                repo_type="dataset",
                revision=commit,
                local_dir=os.fspath(folder),
            )
        )


def download_release(
    out: str | os.PathLike[str],
    hub: HuggingFaceHub,
    *,
    captures: Sequence[str] = (),
    revision: str | None = None,
    pins: Path | None = None,
    update: Callable[[int, int], None] | None = None,
) -> Download:
    """Download the release, or some captures of it.

    On first use the checksum of every file is pinned for its commit in the user's cache; a later
    download of the same commit must bring the same bytes. An interrupted download continues where
    it stopped and stays at its commit. An existing file that differs is never replaced.
    """
    folder = Path(out)
    record = _record(folder)
    if record and revision not in (None, record["revision"], record["commit"]):
        raise UsageError(
            f"holds revision {record['revision'] or record['commit']} already",
            where=folder,
            remedy="Download another revision into another folder.",
        )
    commit, files = _ask(hub.files, record["commit"] if record else revision)
    if not re.fullmatch(r"[0-9A-Za-z._-]{1,64}", commit):
        raise BadInput("the hub does not name a commit", where=REPOSITORY)
    chosen = [
        item
        for item in files
        if not captures
        or any(part.startswith(tuple(captures)) for part in re.split(r"[\\/]", item.name))
    ]
    if not chosen:
        raise UsageError("no file of the release matches", field="--capture")
    targets = {item.name: inside(folder, item.name) for item in chosen}
    path = pins or cache_root() / "pins" / f"{REPOSITORY.replace('/', '--')}@{commit}.json"
    again = "Move it away and run the command again, which pins the checksums that it finds."
    pinned: dict[str, str] = _read(path, again)["files"] if path.is_file() else {}
    folder.mkdir(parents=True, exist_ok=True)
    header = {"schema": SCHEMA, "repository": REPOSITORY, "revision": revision, "commit": commit}
    if record is None:
        write_json(folder / RECORD, {**header, "files": {}})
    else:
        header["revision"] = record["revision"]
    done: dict[str, str] = dict(record["files"]) if record else {}
    kept = 0
    for index, item in enumerate(chosen):
        target = targets[item.name]
        if target.is_file():
            kept += 1
        else:
            _ask(hub.fetch, item.name, commit, folder)
        done[item.name] = _verified(item, target, pinned.get(item.name) or done.get(item.name))
        pinned[item.name] = done[item.name]
        write_json(path, {"schema": SCHEMA, "commit": commit, "files": pinned})
        write_json(folder / RECORD, {**header, "files": done})
        if update is not None:
            update(index + 1, len(chosen))
    packed = tuple(item.name for item in chosen if item.name.lower().endswith(ARCHIVES))
    return Download(folder, commit, done, kept, packed)


def _record(folder: Path) -> dict[str, Any] | None:
    if (folder / RECORD).is_file():
        return {"revision": None, **_read(folder / RECORD)}
    if folder.exists() and (folder.is_file() or any(folder.iterdir())):
        raise UsageError(
            "exists already and was not made by this command",
            where=folder,
            remedy="Choose an empty folder.",
        )
    return None


def _read(path: Path, remedy: str | None = None) -> dict[str, Any]:
    """Read a record or pins, which have the same fields."""
    value = read_json(path)
    good = isinstance(value, dict) and value.get("schema") == SCHEMA
    good = good and isinstance(value.get("commit"), str) and isinstance(value.get("files"), dict)
    if not good or not all(isinstance(digest, str) for digest in value["files"].values()):
        raise BadInput("is not the record of a download", where=path, remedy=remedy)
    return dict(value)


def _verified(item: RemoteFile, target: Path, pinned: str | None) -> str:
    """The file's SHA-256, after it was compared with all that is known of it."""
    if not target.is_file():
        raise BadInput("was not downloaded", where=target)
    digest = sha256_file(target)
    for source, expected in (("pinned on first use", pinned), ("stated by the hub", item.sha256)):
        if expected is not None and digest != expected:
            raise BadInput(
                f"has SHA-256 {digest[:16]} where {expected[:16]} was {source}",
                where=target,
                remedy="It was changed, here or there. Move it away and run the command again; if "
                "it differs again, do not trust it.",
            )
    return digest


def _ask(function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except HwpError:
        raise
    # The hub's library raises errors of several packages: network, permission, disk.
    except Exception as error:
        reason = str(error).strip().split("\n")[0][:200] or type(error).__name__
        raise HwpError(
            f"cannot be downloaded ({reason})",
            where=REPOSITORY,
            remedy="Run the same command again; it continues where it stopped.",
        ) from error
