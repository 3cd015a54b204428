"""Which joint of a rig is which joint of the hand, by the names that rigs give them.

Two schemes are known word by word: WebXR (`index-finger-phalanx-proximal`) and OpenXR as Godot
writes it (`Index_Proximal_R`). Others are read from the words in a name: a finger, and a part or
a number, as in Mixamo (`mixamorig:RightHandIndex1`), VRM and Unity (`rightIndexProximal`),
SMPL-X and MANO (`right_index1`), Unreal (`index_01_r`), Rigify (`DEF-f_index.01.R`), Oculus
(`b_r_index1`) and SteamVR (`finger_index_0_r`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

from hwp_bench.base.errors import BadHandModel

#: Joints of the hand model, in its order, as WebXR names them.
WEBXR = (
    "wrist",
    *(
        f"{finger}-finger-phalanx-{part}"
        for finger in ("index", "middle", "pinky", "ring")
        for part in ("proximal", "intermediate", "distal")
    ),
    "thumb-metacarpal",
    "thumb-phalanx-proximal",
    "thumb-phalanx-distal",
)
#: The same as OpenXR rigs name them, without the side's suffix.
OPENXR = (
    "wrist",
    *(
        f"{finger}_{part}"
        for finger in ("index", "middle", "little", "ring")
        for part in ("proximal", "intermediate", "distal")
    ),
    "thumb_metacarpal",
    "thumb_proximal",
    "thumb_distal",
)
#: Words of a finger, in the hand model's order.
_FINGERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "index": ("index", "forefinger", "pointer"),
        "middle": ("middle", "mid"),
        "little": ("little", "pinky", "pinkie", "small"),
        "ring": ("ring",),
        "thumb": ("thumb",),
    }
)
_SIDES: Mapping[str, str] = MappingProxyType(
    {"right": "right", "r": "right", "left": "left", "l": "left"}
)
_PARTS = ("metacarpal", "meta", "proximal", "intermediate", "medial", "distal")
# Words of joints beyond the last one, or of helpers.
_ASIDE = frozenset(
    (
        "tip",
        "end",
        "nub",
        "aux",
        "null",
        "ik",
        "pole",
        "target",
        "ctrl",
        "twist",
        "roll",
        "effector",
    )
)
_BODY = frozenset(
    (
        *("spine", "chest", "neck", "head", "jaw", "eye", "hip", "hips", "pelvis", "torso"),
        *("leg", "upleg", "thigh", "calf", "knee", "foot", "toe", "ankle"),
        *("breast", "shoulder", "clavicle", "upperarm"),
    )
)
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")


def words(name: str) -> list[str]:
    """The words and numbers in a name, in small letters: `RightHandIndex1` has four."""
    return [word.lower() for word in _WORD.findall(name)]


def side_of_name(name: str) -> str | None:
    """`right` or `left` where a name says so."""
    found = {_SIDES[word] for word in words(name) if word in _SIDES}
    return found.pop() if len(found) == 1 else None


def is_elsewhere(name: str, side: str | None) -> bool:
    """Whether a joint belongs to the body or to the other hand.

    Args:
        name: of the joint.
        side: of the hand that is read, or None where names do not say.
    """
    own = side_of_name(name)
    return bool(_BODY & set(words(name))) or (side is not None and own not in (None, side))


def hand_joints(names: list[str], wanted: str, where: str) -> tuple[list[int], str | None]:
    """Find the joints of a hand.

    Args:
        names: of a rig's joints.
        wanted: the side to take where a rig has both hands.
        where: the file, for messages.

    Returns:
        Row in `names` of the hand model's 16 joints, and the side that the names tell, if any.

    Raises:
        BadHandModel: joints are missing; the message names the first of them.
    """
    plain = [_plain(name.lower()) for name in names]
    sides = {side_of_name(name) for name in names}
    for scheme in (WEBXR, OPENXR):
        if all(name in plain for name in scheme) and len(set(plain)) == len(plain):
            own = {side_of_name(names[plain.index(name)]) for name in scheme}
            return [plain.index(name) for name in scheme], own.pop() if len(own) == 1 else None
    best: list[int | None] = []
    told: str | None = None
    for side in (wanted, None, "left" if wanted == "right" else "right"):
        if side not in sides:
            continue
        found = _by_words(names, side)
        if not best or best.count(None) > found.count(None):
            best, told = found, side
    found_all = [row for row in best if row is not None]
    if best and len(found_all) == len(best):
        return found_all, told
    missing = [WEBXR[i] for i, row in enumerate(best) if row is None] or list(WEBXR)
    raise BadHandModel(
        f"{len(missing)} joints are missing, the first is {missing[0]!r}",
        where=where,
        field="skins[0].joints",
        remedy="Names of WebXR, OpenXR, Mixamo, VRM, SMPL-X, Unreal and Rigify are understood.",
    )


def _by_words(names: list[str], side: str | None) -> list[int | None]:
    fingers: dict[str, dict[str, int]] = {finger: {} for finger in _FINGERS}
    wrists: list[tuple[bool, int, int]] = []
    for row, name in enumerate(names):
        said = words(name)
        if side_of_name(name) != side or _ASIDE & set(said):
            continue
        finger = _finger(said)
        if finger is not None:
            part = _part(said, finger)
            if part is not None:
                fingers[finger].setdefault(part, row)
        elif "wrist" in said or "hand" in said:
            wrists.append(("wrist" not in said, len(said), row))
    found: list[int | None] = [min(wrists)[2] if wrists else None]
    for finger in _FINGERS:
        found += _three(fingers[finger], thumb=finger == "thumb")
    return found


def _finger(said: list[str]) -> str | None:
    for word in said:
        for finger, known in _FINGERS.items():
            if word in known:
                return finger
    return None


def _part(said: list[str], finger: str) -> str | None:
    """The part that a joint's name says, or its number."""
    for word in reversed(said):
        if word in _PARTS and word not in _FINGERS[finger]:
            return word
        if word.isdigit():
            return str(int(word)) if len(word) < 4 else None
    return None


def _three(parts: dict[str, int], *, thumb: bool) -> list[int | None]:
    """The three joints of a finger from its parts, or None for those that are missing."""
    numbers = sorted(int(part) for part in parts if part.isdigit())
    if numbers:
        # A joint before the first three is a bone of the palm, one after them the tip.
        start = 1 if 1 in numbers and 3 in numbers else 0
        return [parts.get(str(start + step)) for step in range(3)]
    middle = "intermediate" if "intermediate" in parts else "medial"
    order = ("proximal", middle, "distal")
    if thumb and middle not in parts:
        order = ("metacarpal" if "metacarpal" in parts else "meta", "proximal", "distal")
    return [parts.get(part) for part in order]


def _plain(name: str) -> str:
    for ending in ("_r", "_l", ".r", ".l", "_right", "_left"):
        name = name.removesuffix(ending)
    return name
