"""A skinned mesh as binary glTF: sixteen joints a hand, a baked texture, and a motion.

The motion is a capture's, or fingers that close and open. The texture is made of pictures of the
avatar from all around, laid onto its skin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from scipy import ndimage

from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import sample
from hwp_bench.base.numerics import kd_tree
from hwp_bench.base.rays import ray_mesh
from hwp_bench.capture import Capture
from hwp_bench.hands import HandTemplate, TemplateTensors, pose_hand, vertex_normals
from hwp_bench.hands.articulation import joint_axes, pose_from_joint_angles
from hwp_bench.hands.skeleton import JOINT_NAMES, PARENTS
from hwp_bench.hands.template import boundary_loop
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.export.splats import (
    ATTRIBUTES,
    INDICES,
    TURNS,
    GlbBuilder,
    middle,
    turned,
    view_turn,
)

#: Texels along an edge.
SIZE = 1024
# How much of the pictures, which are as large as the texture, the hand's ball fills.
_FILLED = 0.95
# Power of the cosine between skin and viewer that a picture counts by, its least value, and how
# much more the front counts.
_POWER, _LEAST, _FRONT = 4.0, 0.15, 4.0
# Skin this far behind the first surface, m, is hidden; Gaussians stand that far off the mesh.
_HIDDEN = 0.003
# A pixel counts where the avatar covers this much of it.
_COVERED = 0.9
# Largest radius of the cap's place in the texture, in texels of 1024, and the space around it.
_CAP, _MARGIN = 24.0, 6.0


@dataclass(frozen=True, eq=False)
class SkinTexture:
    """A texture, and the place in it of the cap that closes the wrist."""

    #: (S, S, 3) uint8 sRGB, row 0 at the top (v = 1).
    image: np.ndarray
    #: (2,) texture coordinates of the middle of the cap, origin at the bottom left.
    cap: np.ndarray
    #: Its radius in texture coordinates; 0 where the layout has no space for it.
    radius: float


def baked(
    avatar: WildGHandAvatar, side: str, layout: HandTemplate, size: int = SIZE
) -> SkinTexture:
    """Lay pictures of a hand at rest onto its skin.

    The hand turns in the studio as in the turntable. A picture counts where it shows the skin:
    facing the camera, nothing in front, covered by Gaussians. Skin that no picture shows takes the
    colour of the nearest skin that one shows; texels outside of the skin that of the nearest texel.
    """
    template = avatar.model.rigs[side].template
    faces = template.faces.cpu().numpy()
    rows, face, mix = skin_texels(layout, size)
    front = avatar.studio.posed()[side]
    centre = middle(avatar.pose({side: front}))
    vertices, _ = _posed(avatar, front)
    camera = _camera(vertices, centre, size)
    total, weight = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for turn, tilt in TURNS:
        hand = turned(avatar, {side: front}, view_turn(camera.viewmat, turn, tilt), centre)[side]
        rgba = avatar.render({side: hand}, camera)
        vertices, normals = _posed(avatar, hand)
        corners = faces[face]
        places = (vertices[corners] * mix[..., None]).sum(axis=1)
        shares = _shares(places, (normals[corners] * mix[..., None]).sum(axis=1))
        shares *= _FRONT if (turn, tilt) == TURNS[0] else 1.0
        looked = np.flatnonzero(shares > 0.0)
        looked = looked[_in_sight(vertices, faces, places[looked])]
        colors, covered = _read(rgba, camera, places[looked])
        shares = shares[looked] * (covered >= _COVERED)
        total[looked] += shares[:, None] * colors
        weight[looked] += shares
    shown = weight > 1e-6
    colors = total / np.maximum(weight, 1e-6)[:, None]
    if shown.any() and not shown.all():
        rest, _ = _posed(avatar, front)
        places = (rest[faces[face]] * mix[..., None]).sum(axis=1)
        _, nearest = kd_tree(places[shown]).query(places[~shown], k=1)
        colors[~shown] = colors[shown][nearest.reshape(-1)]
    image, skin = np.zeros((size * size, 3)), np.zeros(size * size, dtype=bool)
    image[rows], skin[rows] = colors.clip(0.0, 1.0), True
    return _with_cap(avatar, front, image.reshape(size, size, 3), skin.reshape(size, size))


def skin_texels(layout: HandTemplate, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The texels whose middles lie on the skin.

    Returns:
        (M,) their numbers, row by row from the top; (M,) faces; (M, 3) barycentric coordinates.
    """
    flat = np.concatenate([layout.uv, np.zeros((len(layout.uv), 1))], axis=1)
    place = (np.arange(size) + 0.5) / size
    columns, rows = np.meshgrid(place, 1.0 - place)
    above = np.stack([columns.ravel(), rows.ravel(), np.ones(size * size)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (size * size, 1))
    ray, face, u, v, _ = ray_mesh(flat, layout.face_uv).first_hits(above, down)
    return ray, face, np.stack([1.0 - u - v, u, v], axis=1)


def _posed(avatar: WildGHandAvatar, hand: HandPose) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals of the mesh of a hand: (V, 3) each."""
    template = avatar.model.rigs[hand.side].template
    pose, betas, transl = (
        torch.as_tensor(np.asarray(each)[None]).to(template.vertices)
        for each in (hand.pose, hand.betas, hand.transl)
    )
    vertices = pose_hand(template, pose, betas, transl).vertices
    normals = vertex_normals(vertices, template.faces)
    return vertices[0].double().cpu().numpy(), normals[0].double().cpu().numpy()


def _camera(vertices: np.ndarray, centre: np.ndarray, size: int) -> Camera:
    """The studio's camera, with the ball around a hand in its square picture."""
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    half = 0.5 * size
    focal = _FILLED * half * np.sqrt(max(centre[2] ** 2 - radius**2, 1e-6)) / radius
    x, y = half - focal * centre[:2] / centre[2]
    K = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(4), size, size)


def _shares(places: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(M,) how much a picture counts by the angle at which it shows the skin."""
    away = places / np.linalg.norm(places, axis=1, keepdims=True)
    length = np.linalg.norm(normals, axis=1).clip(min=1e-9)
    facing = -(away * normals).sum(axis=1) / length
    return np.where(facing > _LEAST, facing**_POWER, 0.0)


def _in_sight(vertices: np.ndarray, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(M,) whether places of a mesh are visible from a camera at the origin."""
    distance = np.linalg.norm(places, axis=1)
    ray, _, _, _, met = ray_mesh(vertices, faces).first_hits(
        np.zeros((1, 3)), places / distance[:, None]
    )
    found = np.full(len(places), np.inf)
    found[ray] = met
    return found > distance - _HIDDEN


def _read(rgba: np.ndarray, camera: Camera, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (M, 3) and coverage (M,) of a picture at places in front of its camera."""
    pixel = places @ camera.K.T
    read = sample(rgba, pixel[:, :2] / pixel[:, 2:])
    covered = read[:, 3]
    return read[:, :3] / np.maximum(covered, 1e-6)[:, None], covered


def _with_cap(
    avatar: WildGHandAvatar, front: HandPose, image: np.ndarray, skin: np.ndarray
) -> SkinTexture:
    """Fill what lies outside of the skin, and find a place for the cap of the wrist there."""
    size = len(image)
    away, nearest = ndimage.distance_transform_edt(~skin, return_indices=True)
    filled = image[tuple(nearest)]
    # The border of the picture ends the space, too.
    inside = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5)
    space = np.minimum(away, np.minimum(inside[:, None], inside[None]))
    row, column = np.unravel_index(int(space.argmax()), space.shape)
    margin = _MARGIN * size / SIZE
    radius = min(float(space[row, column]) - 2.0 * margin, _CAP * size / SIZE)
    middle_of_cap = np.array([(column + 0.5) / size, 1.0 - (row + 0.5) / size])
    wall = avatar.model.wall(front.side)
    if radius >= 1.0:
        closed = avatar.pose({front.side: front}, closed=True, viewmat=np.eye(4))
        # The discs of the wall come last and have one colour.
        color = closed.colors[-1] if wall is not None else np.median(closed.colors, axis=0)
        down, across = np.mgrid[:size, :size]
        disc = np.hypot(down - row, across - column) <= radius + margin
        filled[disc] = color.clip(0.0, 1.0)
    texels = np.rint(255.0 * filled).astype(np.uint8)
    return SkinTexture(texels, middle_of_cap, max(radius, 0.0) / size if radius >= 1.0 else 0.0)


#: Length and rate of the motion that needs no capture.
SECONDS, FPS = 2.0, 24.0
# Flexion of the closed hand at the three joints of a finger and of the thumb, degrees.
_FINGER, _THUMB = (60.0, 75.0, 45.0), (10.0, 30.0, 35.0)


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """Poses of one or two hands over time."""

    #: (T,) s, rising from 0.
    times: np.ndarray
    #: By side: (T, 16, 3) axis-angle, rad.
    poses: Mapping[str, np.ndarray]
    #: By side: (T, 3) m.
    transls: Mapping[str, np.ndarray]
    #: Whether y points down, as in captures, and not up, as at rest.
    down: bool


def capture_motion(
    avatar: WildGHandAvatar, capture: Capture, sides: tuple[str, ...]
) -> PoseSequence:
    """Return the motion of a capture; frames in which a hand was not found are left out."""
    hands = {side: capture.hands[side] for side in sides}
    kept = np.flatnonzero(np.all([hand.valid for hand in hands.values()], axis=0))
    if not len(kept):
        raise UsageError("has no frame in which all hands were found", where=capture.root)
    frames = [
        avatar.believed({side: hand.at(frame, side) for side, hand in hands.items()})
        for frame in kept.tolist()
    ]
    times = capture.info.frame_times()[kept]
    return PoseSequence(
        times=times - times[0],
        poses={side: np.stack([frame[side].pose for frame in frames]) for side in sides},
        transls={side: np.stack([frame[side].transl for frame in frames]) for side in sides},
        down=True,
    )


def closing_motion(
    templates: Mapping[str, HandTemplate], rest: Mapping[str, HandPose]
) -> PoseSequence:
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
    return PoseSequence(times, poses, transls, down=False)


#: Colours are shown as they are: light is in them already.
UNLIT = "KHR_materials_unlit"
# Weights of a vertex that glTF's first set of attributes holds.
_JOINTS = 4
# Half a turn about x.
_FLIP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SkinnedHand:
    """One hand as glTF takes it: the mesh at rest, texture coordinates, where it lies, its skin."""

    template: TemplateTensors
    layout: HandTemplate
    rest: HandPose
    texture: SkinTexture


def skinned_glb_bytes(
    hands: Mapping[str, SkinnedHand], motion: PoseSequence, generator: str
) -> bytes:
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
        template = hand.template
        moved = template.joint_basis.cpu().numpy().astype(np.float64) @ np.asarray(hand.rest.betas)
        joints = template.joints.cpu().numpy().astype(np.float64) + moved
        first = _add_nodes(made, side, joints, np.asarray(hand.rest.transl))
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
    rest = template.vertices.cpu().numpy().astype(np.float64)
    shape = template.shape_basis.cpu().numpy().astype(np.float64)
    rest = rest + shape @ np.asarray(hand.rest.betas)
    # A vertex on a seam has several texture coordinates: one copy for each.
    pairs = np.stack((layout.faces.ravel(), layout.face_uv.ravel()), axis=1)
    kept, corners = np.unique(pairs, axis=0, return_inverse=True)
    vertex, texel = kept.T
    places, uv, weights = rest[vertex], layout.uv[texel], template.weights.cpu().numpy()[vertex]
    border = boundary_loop(layout.faces)
    if len(border):
        # A fan around the middle closes the open end of the wrist. Its faces run against the
        # edges of the skin, so that the surface has one outside.
        count, skin = len(border), template.weights.cpu().numpy()[border]
        own, following = np.arange(count), (np.arange(count) + 1) % count
        fan = np.stack([following, own, np.full(count, count)], axis=1)
        around = 2.0 * np.pi * own / count
        circle = np.stack([np.cos(around), np.sin(around)], axis=1)
        circle = np.concatenate([hand.texture.radius * circle, np.zeros((1, 2))])
        corners = np.concatenate([corners.reshape(-1, 3), fan + len(places)])
        places = np.concatenate([places, rest[border], rest[border].mean(axis=0, keepdims=True)])
        uv = np.concatenate([uv, circle + hand.texture.cap])
        weights = np.concatenate([weights, skin, skin.mean(axis=0, keepdims=True)])
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


def _add_motion(
    made: GlbBuilder,
    clip: dict[str, Any],
    times: int,
    motion: PoseSequence,
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
    """The four largest weights of each vertex, of (V, 16) whose rows sum to 1.

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
