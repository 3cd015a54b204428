"""Where the LPIPS weights lie, and whether they are the ones that make the number LPIPS.

Nothing is downloaded. The backbone is the torchvision checkpoint in the torch hub cache or a
file given by path; the linear layers come from the `lpips` package (or torchmetrics, which
ships the same bytes) or a file given by path. A file that is not byte for byte the published
one is refused: the number would not be LPIPS.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.base.errors import BadInput, MissingDependency, UsageError

if TYPE_CHECKING:
    from hwp_bench.metrics.lpips import Lpips

#: File names of the torchvision checkpoints, newest first; the hexadecimal part of the name is
#: the start of the file's SHA-256.
BACKBONE_FILES: Mapping[str, tuple[str, ...]] = {
    "alex": ("alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"),
    "vgg": ("vgg16-397923af.pth",),
}
#: SHA-256 of the linear layers, version 0.1.
LINEAR_DIGESTS: Mapping[str, str] = {
    "alex": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    "vgg": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
}
#: Packages that contain the linear layers, and the folder inside them.
LINEAR_PACKAGES = (
    ("lpips", "weights/v0.1"),
    ("torchmetrics", "functional/image/lpips_models"),
)


@dataclass(frozen=True)
class LpipsFiles:
    """The two files that one network needs; None means "look in the usual place"."""

    #: The torchvision checkpoint.
    backbone: Path | None = None
    #: The linear layers of LPIPS 0.1.
    linear: Path | None = None


def lpips_available(net: str, files: LpipsFiles | None = None) -> str | None:
    """Why LPIPS with this backbone cannot be computed here; None if it can.

    Looks for the files only (no torch import, no reading): a damaged file shows in `load_lpips`.
    """
    try:
        find_weights(net, files)
    except MissingDependency as error:
        return str(error)
    return None


def find_weights(net: str, files: LpipsFiles | None = None) -> tuple[Path, Path]:
    """The backbone and the linear file of a network.

    Raises:
        MissingDependency: one is not there; says where it is looked for.
        UsageError: no such network.
    """
    if net not in BACKBONE_FILES:
        raise UsageError(
            f"LPIPS has no network {net!r}", field="net", remedy="There are alex and vgg."
        )
    files = files or LpipsFiles()
    return _find_backbone(net, files.backbone), _find_linear(net, files.linear)


def load_lpips(net: str, files: LpipsFiles | None = None, device: str = "cpu") -> Lpips:
    """LPIPS with the weights found on this machine.

    Raises:
        MissingDependency: a file is not there.
        BadInput: a file is not the published one, or damaged.
    """
    from hwp_bench.metrics.lpips import Lpips

    backbone, linear = find_weights(net, files)
    prefixes = [Path(name).stem.rsplit("-", 1)[1] for name in BACKBONE_FILES[net]]
    return Lpips(
        net,
        _read_state(backbone, prefixes),
        _read_state(linear, [LINEAR_DIGESTS[net]]),
        device,
    )


def load_available(device: str = "cpu") -> dict[str, Lpips]:
    """Every network whose weights lie in the usual places, by name; may be empty."""
    return {
        net: load_lpips(net, device=device)
        for net in BACKBONE_FILES
        if lpips_available(net) is None
    }


def _hub_checkpoints() -> Path:
    """The folder that torch.hub keeps checkpoints in, found without importing torch."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", os.path.join(cache, "torch"))
    return Path(home).expanduser() / "hub" / "checkpoints"


def _find_backbone(net: str, given: Path | None) -> Path:
    folder = _hub_checkpoints()
    candidates = [given] if given else [folder / name for name in BACKBONE_FILES[net]]
    for path in candidates:
        if path.is_file():
            return path
    raise MissingDependency(
        f"the backbone weights of LPIPS ({net}) are not there",
        where=candidates[0],
        remedy=f"Put the torchvision checkpoint {BACKBONE_FILES[net][0]} there.",
    )


def _find_linear(net: str, given: Path | None) -> Path:
    if given is not None:
        if given.is_file():
            return given
        raise MissingDependency("the linear layers of LPIPS are not there", where=given)
    for package, folder in LINEAR_PACKAGES:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            path = Path(root) / folder / f"{net}.pth"
            if path.is_file():
                return path
    raise MissingDependency(
        f"the linear layers of LPIPS ({net}) are not there",
        remedy="Install the package lpips (without its dependencies is enough), or give a path.",
    )


def _read_state(path: Path, digests: list[str]) -> dict[str, Any]:
    """A checkpoint of plain tensors whose SHA-256 starts with one of `digests`."""
    import torch

    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(tuple(digests)):
        raise BadInput(
            f"is not the published checkpoint (SHA-256 {digest[:16]}...)",
            where=path,
            remedy=f"The file's SHA-256 must start with {' or '.join(d[:16] for d in digests)}.",
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        raise BadInput(
            f"cannot be read as a checkpoint of tensors ({type(error).__name__})", where=path
        ) from error
    if not isinstance(state, dict):
        raise BadInput("holds no dictionary of tensors", where=path)
    return state
