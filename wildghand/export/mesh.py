"""A skinned mesh as binary glTF: sixteen joints a hand, a baked texture, and a motion.

The motion is a capture's, or fingers that close and open.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import HandTemplate, TemplateTensors
from hwp_bench.hands.articulation import joint_axes, pose_from_joint_angles
from hwp_bench.hands.skeleton import JOINT_NAMES, PARENTS
from hwp_bench.hands.template import boundary_loop
from hwp_bench.methods.contract import HandPose
from wildghand.avatar import WildGHandAvatar
from wildghand.export.splat_files import ATTRIBUTES, INDICES, GlbBuilder
from wildghand.export.texture import SkinTexture

#: Length and rate of the motion that needs no capture.
SECONDS, FPS = 2.0, 24.0
# Flexion of the closed hand at the three joints of a finger and of the thumb, degrees.
_FINGER, _THUMB = (60.0, 75.0, 45.0), (10.0, 30.0, 35.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one or two hands over time."""

    #: (T,) s, rising from 0.
    times: np.ndarray
    #: By side: (T, 16, 3) axis-angle, rad.
    poses: Mapping[str, np.ndarray]
    #: By side: (T, 3) m.
    transls: Mapping[str, np.ndarray]
    #: Whether y points down, as in captures, and not up, as at rest.
    down: bool


def capture_motion(avatar: WildGHandAvatar, capture: Capture, sides: tuple[str, ...]) -> Motion:
    """Return the motion of a capture; frames in which a hand was not found are left out."""
    hands = {side: capture.hands[side] for side in sides}
    kept = np.flatnonzero(np.all([hand.valid for hand in hands.values()], axis=0))
    if not len(kept):
        raise UsageError("has no frame in which all hands were found", where=capture.root)
    frames = [
        avatar.believed({side: hand.at(frame, side) for side, hand in hands.items()})
        for frame in kept.tolist()
    ]
    return Motion(
        times=(kept - kept[0]) / capture.info.fps,
        poses={side: np.stack([frame[side].pose for frame in frames]) for side in sides},
        transls={side: np.stack([frame[side].transl for frame in frames]) for side in sides},
        down=True,
    )


def closing_motion(templates: Mapping[str, HandTemplate], rest: Mapping[str, HandPose]) -> Motion:
    """Return a motion in which the fingers close and open once."""
    times = np.arange(round(SECONDS * FPS) + 1) / FPS
    share = 0.5 - 0.5 * np.cos(2.0 * math.pi * times / SECONDS)
    flexion = np.radians([*(4 * _FINGER), *_THUMB])
    angles = np.zeros((len(times), 15, 3))
    angles[..., 0] = share[:, None] * flexion
    poses, transls = {}, {}
    for side, template in templates.items():
        axes = torch.from_numpy(joint_axes(template))
        poses[side] = np.zeros((len(times), 16, 3))
        poses[side][:, 1:] = pose_from_joint_angles(torch.from_numpy(angles), axes).numpy()
        transls[side] = np.tile(rest[side].transl, (len(times), 1))
    return Motion(times, poses, transls, down=False)


#: Colours are shown as they are: light is in them already.
UNLIT = "KHR_materials_unlit"
# Weights of a vertex that glTF's first set of attributes holds.
_JOINTS = 4
# Half a turn about x.
_FLIP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SkinnedHand:
    """One hand as glTF takes it."""

    #: The mesh at rest, with the person's shape.
    template: TemplateTensors
    #: Its texture coordinates.
    layout: HandTemplate
    #: (10,) shape parameters.
    betas: np.ndarray
    #: (3,) m, where it lies at rest.
    transl: np.ndarray
    texture: SkinTexture


def skinned_glb_bytes(hands: Mapping[str, SkinnedHand], motion: Motion, generator: str) -> bytes:
    """Return hands with skeletons, in glTF's axes: y up, metres.

    The wrist's node moves the hand; the middle of the motion lies at the origin.
    """
    made = GlbBuilder(generator)
    content = made.content
    content |= {
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": []}],
        **{name: [] for name in ("nodes", "meshes", "skins", "materials", "textures")},
        "samplers": [{"magFilter": 9729, "minFilter": 9987}],
    }
    clip: dict[str, Any] = {"name": "motion", "channels": [], "samplers": []}
    times = made.array(motion.times.astype(np.float32), bounds=True)
    centre = np.concatenate(list(motion.transls.values())).mean(axis=0)
    for side, hand in hands.items():
        require_skinning(hand.template)
        joints = _joints(hand)
        first = _add_nodes(made, side, joints, hand.transl)
        _add_mesh(made, side, hand, joints, first)
        _add_motion(made, clip, times, motion, side, joints, first, centre)
    content["animations"] = [clip]
    return made.to_bytes()


def require_skinning(template: TemplateTensors) -> None:
    """Refuse a hand model that changes its shape with the pose beyond skinning."""
    if template.pose_basis is not None:
        raise UsageError(
            "changes its shape with the pose, which a skinned mesh cannot",
            field="hand_model",
            remedy="Export Gaussians (.ply, .spz), or fit with the free hand.",
        )


def _joints(hand: SkinnedHand) -> np.ndarray:
    """(16, 3) m, of the person at rest."""
    template = hand.template
    moved = template.joint_basis.numpy().astype(np.float64) @ hand.betas
    return np.asarray(template.joints.numpy().astype(np.float64) + moved)


def _add_nodes(made: GlbBuilder, side: str, joints: np.ndarray, transl: np.ndarray) -> int:
    """Add the skeleton, and return the number of the wrist's node."""
    nodes = made.content["nodes"]
    first = len(nodes)
    for joint, (name, parent) in enumerate(zip(JOINT_NAMES, PARENTS, strict=True)):
        place = joints[0] + transl if parent < 0 else joints[joint] - joints[parent]
        node: dict[str, Any] = {"name": f"{side}_{name}", "translation": place.tolist()}
        if children := [first + other for other, own in enumerate(PARENTS) if own == joint]:
            node["children"] = children
        nodes.append(node)
    made.content["scenes"][0]["nodes"].append(first)
    return first


def _add_mesh(
    made: GlbBuilder, side: str, hand: SkinnedHand, joints: np.ndarray, first: int
) -> None:
    """Add mesh, texture, skin, and the node that shows them."""
    content, template, layout = made.content, hand.template, hand.layout
    rest = template.vertices.numpy().astype(np.float64)
    rest = rest + template.shape_basis.numpy().astype(np.float64) @ hand.betas
    # A vertex on a seam has several texture coordinates: one copy for each.
    pairs = np.stack((layout.faces.ravel(), layout.face_uv.ravel()), axis=1)
    kept, corners = np.unique(pairs, axis=0, return_inverse=True)
    vertex, texel = kept.T
    places, uv, weights = rest[vertex], layout.uv[texel], template.weights.numpy()[vertex]
    border = boundary_loop(layout.faces)
    if len(border):
        cap = wrist_cap(rest[border], template.weights.numpy()[border], hand.texture)
        corners = np.concatenate([corners.reshape(-1, 3), cap.faces + len(places)])
        places = np.concatenate([places, cap.places])
        uv, weights = np.concatenate([uv, cap.uv]), np.concatenate([weights, cap.weights])
    # glTF counts v from the top.
    uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)
    numbers, shares = strongest(weights)
    attributes = {
        "POSITION": made.array(places.astype(np.float32), ATTRIBUTES, bounds=True),
        "TEXCOORD_0": made.array(uv.astype(np.float32), ATTRIBUTES),
        "JOINTS_0": made.array(numbers, ATTRIBUTES),
        "WEIGHTS_0": made.array(shares, ATTRIBUTES),
    }
    faces = made.array(corners.reshape(-1).astype(np.uint32), INDICES)
    _, png = cv2.imencode(".png", hand.texture.image[..., ::-1])
    place = len(content["meshes"])
    content["textures"].append({"source": made.image(png.tobytes()), "sampler": 0})
    content["materials"].append(
        {
            "name": f"{side}_skin",
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": place},
                "metallicFactor": 0.0,
                "roughnessFactor": 0.7,
            },
            "extensions": {UNLIT: {}},
        }
    )
    primitive = {"attributes": attributes, "indices": faces, "material": place}
    content["meshes"].append({"name": f"{side}_hand", "primitives": [primitive]})
    bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    bind[:, :3, 3] = -joints
    content["skins"].append(
        {
            "name": f"{side}_skeleton",
            "joints": list(range(first, first + len(joints))),
            "skeleton": first,
            "inverseBindMatrices": made.array(bind),
        }
    )
    content["scenes"][0]["nodes"].append(len(content["nodes"]))
    content["nodes"].append({"name": f"{side}_hand", "mesh": place, "skin": place})


@dataclass(frozen=True, eq=False)
class WristCap:
    """What closes the open end of a wrist: a fan around its middle."""

    #: (L + 1, 3) m, the border's vertices and their middle.
    places: np.ndarray
    #: (L + 1, 2) texture coordinates, origin at the bottom left.
    uv: np.ndarray
    #: (L + 1, 16) rows sum to 1.
    weights: np.ndarray
    #: (L, 3) counter-clockwise seen from outside.
    faces: np.ndarray


def wrist_cap(border: np.ndarray, weights: np.ndarray, texture: SkinTexture) -> WristCap:
    """Close the open end of a wrist.

    Args:
        border: (L, 3) m, vertices around it in the direction of the faces' own edges.
        weights: (L, 16) skinning weights.
    """
    count = len(border)
    around = 2.0 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    uv = np.concatenate([texture.radius * circle, np.zeros((1, 2))]) + texture.cap
    own, following = np.arange(count), (np.arange(count) + 1) % count
    return WristCap(
        places=np.concatenate([border, border.mean(axis=0, keepdims=True)]),
        uv=uv,
        weights=np.concatenate([weights, weights.mean(axis=0, keepdims=True)]),
        # Against the edges of the skin, so that the surface has one outside.
        faces=np.stack([following, own, np.full(count, count)], axis=1),
    )


def _add_motion(
    made: GlbBuilder,
    clip: dict[str, Any],
    times: int,
    motion: Motion,
    side: str,
    joints: np.ndarray,
    first: int,
    centre: np.ndarray,
) -> None:
    """Add the turns of all joints and the wrist's way to a clip."""
    flip = _FLIP if motion.down else np.ones(3)
    shift = centre if motion.down else np.zeros(3)
    way = (joints[0] + motion.transls[side] - shift) * flip

    def channel(node: int, path: str, values: np.ndarray) -> None:
        clip["channels"].append(
            {"sampler": len(clip["samplers"]), "target": {"node": node, "path": path}}
        )
        clip["samplers"].append({"input": times, "output": made.array(values.astype(np.float32))})

    channel(first, "translation", way)
    for joint in range(len(joints)):
        turns = quaternions(motion.poses[side][:, joint])
        if joint == 0 and motion.down:
            turns = _half_turned(turns)
        channel(first + joint, "rotation", turns)


def strongest(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the four largest weights of each vertex.

    Args:
        weights: (V, 16), rows sum to 1.

    Returns:
        (V, 4) uint8 joints and (V, 4) float32 weights that sum to 1; 0 stands at joint 0.
    """
    order = np.argsort(-weights, axis=1, kind="stable")[:, :_JOINTS]
    kept = np.take_along_axis(weights, order, axis=1).astype(np.float64)
    shares = (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(shares > 0.0, order, 0).astype(np.uint8), shares


def quaternions(axis_angles: np.ndarray) -> np.ndarray:
    """(T, 3) axis-angle to (T, 4) unit quaternions (x, y, z, w) without jumps of sign."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_rotvec(axis_angles).as_quat()
    jumps = (found[1:] * found[:-1]).sum(axis=1) < 0.0
    signs = np.cumprod(np.concatenate(([1.0], np.where(jumps, -1.0, 1.0))))
    return np.asarray(found * signs[:, None])


def _half_turned(quats: np.ndarray) -> np.ndarray:
    """Half a turn about x after each of (T, 4) quaternions (x, y, z, w)."""
    x, y, z, w = quats.T
    return np.stack((w, -z, y, -x), axis=1)
