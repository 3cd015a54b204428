"""Settings that name a file of a person's, `KIND:PATH`: found, checked, shown to a method.

A method lists them in `method.toml`, with the kinds that name a file:

    files = { "regions" = ["sam"], "perceptual" = ["vgg19"] }

What a person sets this way needs no `--expose`. A preset exposes nothing: it comes with the method.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.methods.manifest import MethodManifest


def find_setting_files(
    manifest: MethodManifest, values: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """Make the paths in a person's settings absolute, since a method runs in another folder.

    Args:
        manifest: the method.
        values: settings by name; `a.b` and tables within tables are the same.

    Returns:
        The settings with absolute paths, and the files and folders that they name.

    Raises:
        UsageError: there is no such file or folder.
    """
    found: list[Path] = []

    def resolve(table: Mapping[str, Any], prefix: str) -> dict[str, Any]:
        made: dict[str, Any] = {}
        for name, value in table.items():
            full = f"{prefix}{name}"
            if isinstance(value, Mapping):
                made[name] = resolve(value, f"{full}.")
            elif isinstance(value, str):
                made[name] = _absolute(manifest.files.get(full, ()), full, value, found)
            else:
                made[name] = value
        return made

    return resolve(values, ""), tuple(dict.fromkeys(found))


def check_settings(
    manifest: MethodManifest, values: Mapping[str, Any], field: str = "settings"
) -> None:
    """Refuse settings that cannot work, before anything is rendered or run.

    Names are checked, and files that settings name must be there. What a method that ships has to
    say of those files (`check_files` in its `method.toml`) is asked too. Of another method
    nothing is imported here: its code runs in the sandbox only.

    Args:
        manifest: the method.
        values: a person's settings.
        field: where they come from, for the message.

    Raises:
        BadMethod: a name is not a setting of the method, or nearly one where it lists none.
        UsageError: a setting names a file that is not there.
        HwpError: the file is not what the method needs.
    """
    manifest.check_setting_names(values, field)
    manifest.doubt_setting_names(values, field)
    resolved, files = find_setting_files(manifest, values)
    if files and manifest.check_files and ships(manifest.root):
        module, _, function = manifest.check_files.partition(":")
        getattr(importlib.import_module(module), function)(resolved)


def _absolute(kinds: tuple[str, ...], name: str, value: str, found: list[Path]) -> str:
    kind, colon, place = value.partition(":")
    if not colon or kind not in kinds:
        return value
    path = Path(os.path.abspath(Path(place).expanduser()))
    if not place or not path.exists():
        raise UsageError(
            "does not exist" if place else "names no file",
            where=path if place else None,
            field=name,
            remedy=f"Give {kind}:PATH with a file or folder of yours; nothing is downloaded.",
        )
    found.append(path)
    return f"{kind}:{path}"


def ships(root: Path) -> bool:
    """Return whether a method directory is one that ships with the toolkit."""
    places = (PACKAGES / "wildghand", data_folder("baselines"))
    return any(root.resolve().is_relative_to(place.resolve()) for place in places)
