"""A method directory to begin with: the folders of `templates/` are one for each kind."""

from __future__ import annotations

import importlib.util
import keyword
import os
import re
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, atomic_write, refuse_existing
from hwp_bench.base.packages import data_folder
from hwp_bench.methods.manifest import METHOD_NAME

# The name that the files of the templates have and hold.
_NAME = "my_method"


def write_method(folder: str | os.PathLike[str], kind: str) -> list[Path]:
    """Write a method directory that runs; returns its files.

    The method has the name of the folder, and a Python method's module as well.

    Raises:
        UsageError: the folder exists, or its name cannot be that of a method.
    """
    root = Path(folder)
    name = root.absolute().name
    check_name(name, str(root))
    module = re.sub(r"\W|^(?=\d)", "_", name)
    if kind in ("mean", "mesh", "torch") and not _is_free(module):
        raise UsageError(
            f"the module {module!r} would hide another one of this name",
            where=root,
            remedy="Choose another name for the folder.",
        )
    refuse_existing(root)
    files = []
    with atomic_folder(root) as made:
        for source in sorted((data_folder("templates") / kind).iterdir()):
            if not source.is_file():
                continue
            place = source.name.replace(_NAME, module)
            atomic_write(made / place, fill_template(source, name, module))
            files.append(root / place)
        if kind == "predictions":
            (made / "predictions").mkdir()
    return files


def fill_template(source: Path, name: str, module: str = "") -> str:
    """Return the text of a file of a template, with the name of a method and its module."""
    text = source.read_text(encoding="utf-8")
    return text.replace(f'"{_NAME}"', f'"{name}"').replace(_NAME, module)


def check_name(name: str, field: str) -> None:
    """Refuse a name that a method cannot have."""
    if not re.fullmatch(METHOD_NAME, name):
        problem = f"{name[:100]!r} is not a name of letters, digits and . _ -"
        raise UsageError(problem, field=field)


def _is_free(module: str) -> bool:
    """Whether a name can be that of a module, and is not that of one that Python finds."""
    if not module.isidentifier() or keyword.iskeyword(module):
        return False
    found = importlib.util.find_spec(module)
    # A folder without code is a package too, such as the one that is to be made.
    return found is None or found.origin is None
