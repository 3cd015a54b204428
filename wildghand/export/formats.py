"""From an avatar to a file: the extension decides the format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.version import __version__
from hwp_bench.capture import Capture
from hwp_bench.hands import anchor_uv, load_template
from hwp_bench.hands.anchors import SurfaceAnchors
from hwp_bench.methods.contract import HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.playback import shown_sides
from wildghand.export.motion import capture_motion, closing_motion
from wildghand.export.placing import SUPERSPLAT_SCALE, half_turned, scaled
from wildghand.export.ply import ply_bytes
from wildghand.export.skinned_glb import SkinnedHand, skinned_glb_bytes
from wildghand.export.splat_glb import splat_glb_bytes
from wildghand.export.spz import spz_bytes
from wildghand.export.texture import baked

#: Content by extension.
FORMATS = {
    ".ply": "Gaussians in the layout of 3DGS",
    ".spz": "Gaussians, a tenth of the size, with rounded numbers",
    ".glb": "Gaussians as glTF (KHR_gaussian_splatting, a release candidate), or with --mesh a "
    "skinned mesh with a texture and a motion",
}
_GENERATOR = f"wildghand {__version__}"


@dataclass(frozen=True)
class ExportSettings:
    """Choices of an export."""

    #: A skinned mesh instead of Gaussians; .glb only.
    mesh: bool = False
    #: Units of the file in a metre; of Gaussians.
    scale: float = 1.0
    #: The axes and ten times the size that SuperSplat shows well; .ply only.
    supersplat: bool = False


def check_target(path: Path, settings: ExportSettings, *, overwrite: bool) -> None:
    """Refuse what cannot be written, before anything is read.

    Raises:
        UsageError: the extension is not known, does not go with the settings, or the file is
            there and may not be replaced.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
        raise UsageError(
            f"has the extension {suffix!r}, which is not a format",
            where=path,
            remedy=f"Use {known}.",
        )
    if settings.mesh and suffix != ".glb":
        raise UsageError("a mesh is written as .glb", where=path, field="--mesh")
    if settings.mesh and settings.scale != 1.0:
        raise UsageError("a mesh is in metres", where=path, field="--scale")
    if settings.supersplat and suffix != ".ply":
        raise UsageError("is for .ply", where=path, field="--supersplat")
    if settings.supersplat and settings.scale != 1.0:
        raise UsageError("sets the scale itself", where=path, field="--supersplat")
    if path.exists() and not overwrite:
        raise UsageError("exists", where=path, remedy="Give --overwrite to replace it.")


def export(
    avatar: WildGHandAvatar,
    path: Path,
    settings: ExportSettings | None = None,
    *,
    capture: Capture | None = None,
    frame: int | None = None,
    overwrite: bool = False,
) -> dict[str, int]:
    """Write an avatar for other programs.

    Args:
        avatar: what is written.
        path: the file; its extension decides the format.
        settings: what is exported; the defaults if None.
        capture: Gaussians are posed by a frame of it, a mesh gets its motion; without one the
            Gaussians are at rest, and the mesh's fingers close and open.
        frame: which frame of the capture, for Gaussians; the first if None.
        overwrite: replace what exists.

    Returns:
        Counts of what is in the file, by name.

    Raises:
        UsageError: `check_target` refuses it; the capture shows none of the avatar's hands, or
            belongs to another hand model.
    """
    settings = settings or ExportSettings()
    check_target(path, settings, overwrite=overwrite)
    hands = avatar.rest_poses()
    if capture is not None:
        shown = capture.hand_poses(frame or 0)
        hands = {side: shown[side] for side in shown_sides(avatar, capture)}
    if settings.mesh:
        return _write_mesh(avatar, path, hands, capture)
    splats = avatar.pose(hands, closed=True)
    posed = _splat_bytes(splats, path.suffix.lower(), settings, capture is not None)
    atomic_write(path, posed[0])
    return {"gaussians": posed[1]}


def _splat_bytes(
    splats: PosedGaussians, suffix: str, settings: ExportSettings, down: bool
) -> tuple[bytes, int]:
    """The file of Gaussians, and their number.

    Args:
        down: whether y points down, as in captures, and not up, as at rest.
    """
    count = len(splats)
    if suffix == ".ply":
        scale = SUPERSPLAT_SCALE if settings.supersplat else settings.scale
        placed = scaled(splats, scale)
        if settings.supersplat and not down:
            placed, down = half_turned(placed), True
        comments = (
            f"{_GENERATOR}",
            f"{scale:g} units are a metre",
            "y is down, z is front" if down else "y is up (out of the back of the hand)",
        )
        return ply_bytes(placed, comments), count
    placed = scaled(half_turned(splats) if down else splats, settings.scale)
    if suffix == ".spz":
        return spz_bytes(placed), count
    return splat_glb_bytes(placed, _GENERATOR), count


def _write_mesh(
    avatar: WildGHandAvatar, path: Path, hands: Mapping[str, HandPose], capture: Capture | None
) -> dict[str, int]:
    rest = {side: pose for side, pose in avatar.rest_poses().items() if side in hands}
    layouts = {side: load_template(avatar.hand_model.source, side) for side in rest}
    skinned = {}
    for side, pose in rest.items():
        rig = avatar.model.rigs[side]
        anchors = SurfaceAnchors(
            np.asarray(rig.anchors.face_index), np.asarray(rig.anchors.barycentric)
        )
        splats = avatar.pose({side: pose})
        texture = baked(anchor_uv(layouts[side], anchors), splats.colors, splats.opacities)
        skinned[side] = SkinnedHand(
            rig.template, layouts[side], np.asarray(pose.betas), np.asarray(pose.transl), texture
        )
    if capture is None:
        motion = closing_motion(layouts, rest)
    else:
        motion = capture_motion(avatar, capture, tuple(rest))
    atomic_write(path, skinned_glb_bytes(skinned, motion, _GENERATOR))
    return {"hands": len(skinned), "keys": len(motion.times)}
