"""From an avatar to a file: the extension decides the format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, refuse_existing_file
from hwp_bench.base.packages import __version__
from hwp_bench.capture import Capture
from hwp_bench.hands import load_template
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.render import shown_sides
from wildghand.export.mesh import (
    SIZE,
    SkinnedHand,
    baked,
    capture_motion,
    closing_motion,
    require_skinning,
    skinned_glb_bytes,
)
from wildghand.export.splats import (
    HALF_TURN,
    MAX_DEGREE,
    SUPERSPLAT_SCALE,
    SeenGaussians,
    even_harmonics,
    for_supersplat,
    harmonics,
    laid_to_rest,
    ply_bytes,
    require_scale,
    scaled,
    seen,
    splat_glb_bytes,
    spz_bytes,
    standing,
)

#: Content by extension.
FORMATS = {
    ".ply": "Gaussians in the layout of 3DGS",
    ".spz": "Gaussians, a tenth of the size, with rounded numbers",
    ".glb": "Gaussians as glTF (KHR_gaussian_splatting), or with --mesh a "
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
    #: Upright, the palm to SuperSplat's first view, and ten times the size; .ply only.
    supersplat: bool = False
    #: Degree of the spherical harmonics by which the colours of Gaussians change with the side they
    #: are seen from, 0 to 3; None: 3.
    harmonics: int | None = None
    #: Edge of a mesh's texture, texels, 64 to 4096; None: 1024.
    texture: int | None = None


def check_target(path: Path, settings: ExportSettings, *, overwrite: bool) -> None:
    """Refuse what cannot be written, before anything is read."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
        raise UsageError(
            f"has the extension {suffix!r}, which is not a format",
            where=path,
            remedy=f"Use {known}.",
        )
    other = settings.scale != 1.0
    for field, given, problem in (
        ("--mesh", settings.mesh and suffix != ".glb", "a mesh is written as .glb"),
        ("--scale", settings.mesh and other, "a mesh is in metres"),
        ("--harmonics", settings.mesh and settings.harmonics is not None, "is of Gaussians"),
        ("--texture", not settings.mesh and settings.texture is not None, "is of a mesh (--mesh)"),
        ("--supersplat", settings.supersplat and suffix != ".ply", "is for .ply"),
        ("--supersplat", settings.supersplat and other, "sets the scale itself"),
    ):
        if given:
            raise UsageError(problem, where=path, field=field)
    require_scale(settings.scale)
    if settings.harmonics is not None and not 0 <= settings.harmonics <= MAX_DEGREE:
        raise UsageError(f"is {settings.harmonics}", field="--harmonics", remedy="Use 0 to 3.")
    if settings.texture is not None and not 64 <= settings.texture <= 4096:
        raise UsageError(f"is {settings.texture}", field="--texture", remedy="Use 64 to 4096.")
    refuse_existing_file(path, overwrite=overwrite)


def export(
    avatar: WildGHandAvatar,
    path: Path,
    settings: ExportSettings | None = None,
    *,
    capture: Capture | None = None,
    frame: int | None = None,
    overwrite: bool = False,
) -> dict[str, int]:
    """Write an avatar for other programs."""
    settings = settings or ExportSettings()
    check_target(path, settings, overwrite=overwrite)
    if settings.mesh:
        texels = SIZE if settings.texture is None else settings.texture
        data, counts = _mesh_bytes(avatar, capture, texels)
    else:
        data, counts = _splat_bytes(avatar, path.suffix.lower(), settings, capture, frame or 0)
    atomic_write(path, data, overwrite=overwrite, flag="--overwrite")
    return counts


def export_gaussians(
    splats: PosedGaussians,
    path: Path,
    settings: ExportSettings | None = None,
    *,
    overwrite: bool = False,
) -> dict[str, int]:
    """Write Gaussians with one colour each for other programs, where they lie; y is down."""
    settings = settings or ExportSettings()
    check_target(path, settings, overwrite=overwrite)
    for field in ("mesh", "supersplat", "harmonics"):
        if getattr(settings, field):
            raise UsageError("needs an avatar, not Gaussians of one pose", field=f"--{field}")
    suffix = path.suffix.lower()
    if suffix != ".ply":
        # Not seen from any side: only the geometry is turned.
        none = np.zeros((0, len(splats), 3))
        splats = (
            SeenGaussians(splats, none, none, none[..., 0]).moved(HALF_TURN, np.zeros(3)).splats
        )
    placed = scaled(splats, settings.scale)
    colors = even_harmonics(splats.colors)
    data = _file_of(placed, colors, suffix, settings.scale, "y is down, z is front")
    atomic_write(path, data, overwrite=overwrite, flag="--overwrite")
    return {"gaussians": len(placed)}


def _splat_bytes(
    avatar: WildGHandAvatar,
    suffix: str,
    settings: ExportSettings,
    capture: Capture | None,
    frame: int,
) -> tuple[bytes, dict[str, int]]:
    """The file of Gaussians, and their number."""
    place = standing(avatar, capture, frame)
    given, down = seen(avatar, place), capture is not None
    scale = SUPERSPLAT_SCALE if settings.supersplat else settings.scale
    if settings.supersplat:
        given = for_supersplat(avatar, given, place.hands)
        axes = "y is down; upright, the palm to SuperSplat's first view"
    elif not down:
        given = laid_to_rest(avatar, given, place.hands)
        axes = "y is up (out of the back of the hand)"
    else:
        axes = "y is down, z is front"
    if suffix != ".ply" and down:
        given = given.moved(HALF_TURN, np.zeros(3))
    degree = MAX_DEGREE if settings.harmonics is None else settings.harmonics
    placed, colors = scaled(given.splats, scale), harmonics(given, degree)
    return _file_of(placed, colors, suffix, scale, axes), {"gaussians": len(placed)}


def _file_of(
    placed: PosedGaussians, colors: np.ndarray, suffix: str, scale: float, axes: str
) -> bytes:
    """The bytes of a file of Gaussians with the harmonics of their colours."""
    if suffix == ".ply":
        return ply_bytes(placed, colors, (_GENERATOR, f"{scale:g} units are a metre", axes))
    if suffix == ".spz":
        return spz_bytes(placed, colors)
    return splat_glb_bytes(placed, colors, _GENERATOR)


def _mesh_bytes(
    avatar: WildGHandAvatar, capture: Capture | None, size: int
) -> tuple[bytes, dict[str, int]]:
    """The file of a skinned mesh, and counts of what is in it."""
    sides = avatar.sides if capture is None else shown_sides(avatar, capture)
    rest = {side: pose for side, pose in avatar.rest_poses().items() if side in sides}
    layouts = {side: load_template(avatar.hand_model.source, side) for side in rest}
    skinned = {}
    for side, pose in rest.items():
        template, layout = avatar.model.rigs[side].template, layouts[side]
        require_skinning(template)
        texture = baked(avatar, side, layout, size)
        skinned[side] = SkinnedHand(template, layout, pose, texture)
    if capture is None:
        motion = closing_motion(layouts, rest)
    else:
        motion = capture_motion(avatar, capture, tuple(rest))
    counts = {"hands": len(skinned), "keys": len(motion.times)}
    return skinned_glb_bytes(skinned, motion, _GENERATOR), counts
