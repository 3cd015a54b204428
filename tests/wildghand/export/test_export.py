"""Exported avatars. Oracles: splat-transform (whose SPZ codec is Niantic's), pygltflib, trimesh,
the Khronos validator, an implementation of glTF's skinning, and the avatar's own Gaussians."""

from __future__ import annotations

import copy
import gzip
import io
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from skimage.color import rgb2xyz
from skimage.color.colorconv import xyz_from_rgb
from splat_files import read_ply
from splat_transform import transform, validation_errors
from tiny_fits import TINY

import wildghand
import wildghand.page
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import pose_hand
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.files import save_avatar
from wildghand.cli.main import main
from wildghand.export.formats import FORMATS, ExportSettings, export
from wildghand.export.mesh import capture_motion, quaternions, strongest
from wildghand.export.splats import (
    FRACTIONAL_BITS,
    SH_CONSTANT,
    GlbBuilder,
    packed_rotations,
    ply_bytes,
    scaled,
    splat_glb_bytes,
    spz_bytes,
)


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    capture = make_painted()
    return wildghand.fit(capture.root, settings=TINY, steps=2, all_frames=True), capture


def turns(quats: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions (w, x, y, z) to matrices, by SciPy."""
    return Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()


def some_splats(count: int = 200, seed: int = 0) -> PosedGaussians:
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    return PosedGaussians(
        means=random.uniform(-0.3, 0.3, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(random.uniform(-8.0, -4.0, (count, 3))).astype(np.float32),
        opacities=random.uniform(0.02, 0.98, count).astype(np.float32),
        colors=random.uniform(0.0, 1.0, (count, 3)).astype(np.float32),
    )


def even(splats: PosedGaussians) -> np.ndarray:
    """Harmonics of colours that are the same from every side."""
    return ((splats.colors - 0.5) / SH_CONSTANT)[:, None]


def half_turned(splats: PosedGaussians) -> PosedGaussians:
    """Half a turn about x, by SciPy."""
    spun = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * Rotation.from_quat(
        np.roll(splats.quats, -1, axis=1)
    )
    means = (splats.means * [1.0, -1.0, -1.0]).astype(np.float32)
    return replace(splats, means=means, quats=np.roll(spun.as_quat(), 1, axis=1))


def motion_between(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift from points to others that lie alike, by SciPy."""
    turn, _ = Rotation.align_vectors(others - others.mean(axis=0), points - points.mean(axis=0))
    matrix = turn.as_matrix()
    return matrix, others.mean(axis=0) - matrix @ points.mean(axis=0)


def vertices_of(avatar: WildGHandAvatar, hand: HandPose) -> np.ndarray:
    given = (np.asarray(each)[None] for each in (hand.pose, hand.betas, hand.transl))
    tensors = (torch.as_tensor(each, dtype=torch.float32) for each in given)
    template = avatar.model.rigs[hand.side].template
    return pose_hand(template, *tensors).vertices[0].double().numpy()


def to_rest(avatar: WildGHandAvatar) -> tuple[np.ndarray, np.ndarray]:
    """The motion from the studio to the hand model's rest, by the mesh's vertices."""
    places = (avatar.studio.posed()["right"], avatar.rest_poses()["right"])
    return motion_between(*(vertices_of(avatar, hand) for hand in places))


def with_walls(avatar: WildGHandAvatar) -> PosedGaussians:
    """The Gaussians of an avatar as they stand in the studio, wrist closed, moved to rest."""
    shown = avatar.pose(avatar.studio.posed(), closed=True, viewmat=np.eye(4))
    assert len(shown) > 300
    turn, shift = to_rest(avatar)
    quats = Rotation.from_matrix(turn @ turns(shown.quats)).as_quat()
    return replace(shown, means=shown.means @ turn.T + shift, quats=np.roll(quats, 1, axis=1))


def same_turns(found: np.ndarray, wanted: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(turns(found), turns(wanted), atol=tolerance)


def test_a_ply_holds_the_avatars_gaussians_and_says_its_unit(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    path = tmp_path / "hand.ply"
    wanted = with_walls(avatar)
    assert export(avatar, path) == {"gaussians": len(wanted)}
    assert b"comment 1 units are a metre\n" in path.read_bytes()
    found = read_ply(path)
    np.testing.assert_allclose(found.means, wanted.means, atol=2e-6)
    for name in ("scales", "opacities"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6, err_msg=name
        )
    same_turns(found.quats, wanted.quats, 1e-5)
    # trimesh reads it as a cloud of points.
    cloud = trimesh.load(io.BytesIO(path.read_bytes()), file_type="ply")
    np.testing.assert_allclose(cloud.vertices, wanted.means, atol=2e-6)


def test_a_pose_of_a_capture_is_exported(fitted, tmp_path: Path) -> None:
    avatar, capture = fitted
    export(avatar, tmp_path / "hand.ply", capture=capture, frame=7)
    wanted = avatar.pose(capture.hand_poses(7), closed=True)
    np.testing.assert_allclose(read_ply(tmp_path / "hand.ply").means, wanted.means, atol=1e-6)
    assert b"comment y is down" in (tmp_path / "hand.ply").read_bytes()


@pytest.mark.parametrize("posed", [True, False])
def test_supersplat_opens_a_hand_upright_with_its_palm_to_the_viewer(
    fitted, tmp_path: Path, posed: bool
) -> None:
    """Oracle: SuperSplat's source. It turns a file half around z, its camera stands at azimuth -45
    degrees (0 is +z, 90 is +x) of a y-up world, and the studio's camera sees the palm upright."""
    avatar, capture = fitted
    hands = capture.hand_poses(7) if posed else avatar.studio.posed()
    given = {"capture": capture, "frame": 7} if posed else {}
    export(avatar, tmp_path / "hand.ply", ExportSettings(supersplat=True), **given)
    found, own = read_ply(tmp_path / "hand.ply"), avatar.pose(hands, closed=True)
    turn, _ = motion_between(own.means.astype(np.float64), found.means / 10.0)
    np.testing.assert_allclose(found.scales, 10.0 * own.scales, rtol=1e-4)
    np.testing.assert_allclose(turns(found.quats), turn @ turns(own.quats), atol=1e-3)
    # From upright in the studio to the world of SuperSplat.
    upright = avatar.studio.posed()["right"].pose[0]
    wrists = [Rotation.from_rotvec(each).as_matrix() for each in (hands["right"].pose[0], upright)]
    world = np.diag([-1.0, -1.0, 1.0]) @ turn @ wrists[0] @ wrists[1].T
    np.testing.assert_allclose(world @ [0.0, -1.0, 0.0], [0.0, 1.0, 0.0], atol=1e-3)
    azimuth = np.radians(-45.0)
    viewer = [np.sin(azimuth), 0.0, np.cos(azimuth)]
    np.testing.assert_allclose(world @ [0.0, 0.0, -1.0], viewer, atol=1e-3)
    assert np.abs(found.means.min(axis=0) + found.means.max(axis=0)).max() < 1e-4


@pytest.mark.slow
def test_an_spz_is_read_by_niantics_codec(tmp_path: Path) -> None:
    """Tolerances are half a step of each number: 24 bits with 17 behind the point, 8 bits of
    opacity, colour (of 1 / (255 * 0.15)) and log scale (1 / 16), 9 bits and a sign of a turn."""
    splats = some_splats()
    source = tmp_path / "hand.spz"
    source.write_bytes(spz_bytes(splats, even(splats)))
    assert source.read_bytes() == spz_bytes(splats, even(splats))
    found = read_ply(transform(source, tmp_path / "read.ply"))
    # It gives PLY files in axes of their own: y down, z front.
    wanted = half_turned(splats)
    np.testing.assert_allclose(found.means, wanted.means, atol=0.51 / 2**FRACTIONAL_BITS)
    np.testing.assert_allclose(found.opacities, wanted.opacities, atol=0.51 / 255.0)
    step = SH_CONSTANT / (255.0 * 0.15)
    np.testing.assert_allclose(found.colors, wanted.colors, atol=0.51 * step)
    np.testing.assert_allclose(np.log(found.scales), np.log(wanted.scales), atol=0.51 / 16.0)
    # An axis of a Gaussian may point either way. Three components err by half a step, and the
    # fourth by what follows from them.
    along = np.abs((turns(found.quats) * turns(wanted.quats)).sum(axis=1))
    step = 1.0 / (511.0 * np.sqrt(2.0))
    assert np.arccos(along.clip(max=1.0)).max() < 2.0 * np.sqrt(3.0) * step


@given(st.integers(0, 2**31))
def test_packed_rotations_name_the_largest_component(seed: int) -> None:
    quats = some_splats(20, seed).quats
    packed = packed_rotations(quats)
    assert np.array_equal(packed >> 30, np.abs(np.roll(quats, -1, axis=1)).argmax(axis=1))
    assert np.array_equal(packed, packed_rotations(-quats))


def test_spz_refuses_what_lies_beyond_its_reach() -> None:
    with pytest.raises(UsageError, match="64 units"):
        spz_bytes(scaled(some_splats(3), 1000.0), even(some_splats(3)))


def accessor(made: pygltflib.GLTF2, number: int) -> np.ndarray:
    """An array of a glTF file, read by the numbers of its accessor and view."""
    item = made.accessors[number]
    view = made.bufferViews[item.bufferView]
    kind = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[item.type]
    blob = made.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(blob, kind[item.componentType])[: item.count * width].reshape(-1, width)


def attribute(made: pygltflib.GLTF2, name: str) -> np.ndarray:
    return accessor(made, getattr(made.meshes[0].primitives[0].attributes, name))


@pytest.mark.slow
def test_a_glb_of_gaussians_is_the_one_that_splat_transform_writes(tmp_path: Path) -> None:
    """Both files are made of the same Gaussians and hold the same arrays."""
    from wildghand.export.splats import EXTENSION

    splats = some_splats()
    mine, theirs = tmp_path / "mine.glb", tmp_path / "theirs.glb"
    mine.write_bytes(splat_glb_bytes(half_turned(splats), even(splats), "test"))
    (tmp_path / "hand.ply").write_bytes(ply_bytes(splats, even(splats)))
    transform(tmp_path / "hand.ply", theirs)
    found, oracle = (pygltflib.GLTF2().load(str(path)) for path in (mine, theirs))
    kernels = [one.meshes[0].primitives[0].extensions[EXTENSION] for one in (found, oracle)]
    assert kernels[0]["kernel"] == kernels[1]["kernel"]
    assert kernels[0]["colorSpace"] == kernels[1]["colorSpace"]
    assert found.extensionsUsed == oracle.extensionsUsed
    for name, tolerance in (
        ("OPACITY", 1e-5),
        ("SCALE", 1e-6),
        ("SH_DEGREE_0_COEF_0", 1e-4),
    ):
        own, other = (attribute(one, f"{EXTENSION}:{name}") for one in (found, oracle))
        np.testing.assert_allclose(own, other, atol=tolerance, err_msg=name)
    # In both y is up. It lets the front of a PLY face +z; here the camera's view faces +z.
    (places, spins), (their_places, their_spins) = (
        in_world(one, EXTENSION) for one in (found, oracle)
    )
    behind = np.diag([-1.0, 1.0, -1.0])
    np.testing.assert_allclose(places, their_places @ behind, atol=1e-5)
    np.testing.assert_allclose(spins, behind @ their_spins, atol=1e-4)
    # The validator does not know the extension's names; it says the same of both.
    assert validation_errors(mine) == validation_errors(theirs)


def in_world(made: pygltflib.GLTF2, extension: str) -> tuple[np.ndarray, np.ndarray]:
    """Places and turns of the splats after the transforms of the nodes above them."""
    matrix = np.eye(4)
    number = made.scenes[made.scene or 0].nodes[0]
    while True:
        node = made.nodes[number]
        matrix = matrix @ local_matrix(node)
        if node.mesh is not None:
            break
        number = node.children[0]
    turn = matrix[:3, :3]
    spins = Rotation.from_quat(attribute(made, f"{extension}:ROTATION")).as_matrix()
    return attribute(made, "POSITION") @ turn.T + matrix[:3, 3], turn @ spins


def local_matrix(node: pygltflib.Node) -> np.ndarray:
    matrix = np.eye(4)
    if node.matrix:
        return np.array(node.matrix).reshape(4, 4).T
    if node.rotation:
        matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    if node.scale:
        matrix[:3, :3] *= np.array(node.scale)
    if node.translation:
        matrix[:3, 3] = node.translation
    return matrix


def skinned(made: pygltflib.GLTF2, key: int, mesh: int = 0) -> np.ndarray:
    """The vertices of a mesh at a key of the animation: glTF 2.0, sections 3.7.3 and 3.11."""
    nodes = [replace_node(node) for node in made.nodes]
    clip = made.animations[0]
    for channel in clip.channels:
        values = accessor(made, clip.samplers[channel.sampler].output)
        setattr(nodes[channel.target.node], channel.target.path, values[key].tolist())
    above = {child: number for number, node in enumerate(nodes) for child in node.children or []}

    def world(number: int) -> np.ndarray:
        own = local_matrix(nodes[number])
        return world(above[number]) @ own if number in above else own

    skin = made.skins[mesh]
    inverse = accessor(made, skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    joints = np.stack([world(number) for number in skin.joints]) @ inverse
    attributes = made.meshes[mesh].primitives[0].attributes
    points = accessor(made, attributes.POSITION).astype(np.float64)
    points = np.concatenate((points, np.ones((len(points), 1))), axis=1)
    numbers, weights = accessor(made, attributes.JOINTS_0), accessor(made, attributes.WEIGHTS_0)
    mixed = (joints[numbers] * weights[..., None, None]).sum(axis=1)
    return np.einsum("nij,nj->ni", mixed, points)[:, :3]


def replace_node(node: pygltflib.Node) -> pygltflib.Node:
    return pygltflib.Node(
        children=node.children,
        mesh=node.mesh,
        translation=node.translation,
        rotation=node.rotation,
        scale=node.scale,
        matrix=node.matrix,
    )


@pytest.mark.parametrize("posed", [True, False])
def test_a_skinned_mesh_moves_as_the_hand_does(fitted, tmp_path: Path, posed: bool) -> None:
    avatar, capture = fitted
    path = tmp_path / "hand.glb"
    given = capture if posed else None
    counts = export(avatar, path, ExportSettings(mesh=True, texture=256), capture=given)
    made = pygltflib.GLTF2().load(str(path))
    assert counts["keys"] == accessor(made, made.animations[0].samplers[0].input).shape[0]
    assert [len(skin.joints) for skin in made.skins] == [16]
    template = avatar.model.rigs["right"].template
    keys = (0, 11, counts["keys"] - 1) if posed else (0,)
    for key in keys:
        found = skinned(made, key)
        if posed:
            hand = capture.hand_poses(key)["right"]
            pose, betas, transl = (
                torch.as_tensor(value[None], dtype=torch.float32)
                for value in (hand.pose, avatar.betas["right"], hand.transl)
            )
        else:
            pose, betas = torch.zeros(1, 16, 3), torch.tensor(avatar.betas["right"])[None].float()
            transl = torch.zeros(1, 3)
        wanted = pose_hand(template, pose, betas, transl).vertices[0].double().numpy()
        if posed:
            centre = capture.hands["right"].transl.mean(axis=0)
            wanted = (wanted - centre) * [1.0, -1.0, -1.0]
        # Vertices are doubled on seams: each has its place among the hand's, and none is missing.
        from scipy.spatial import cKDTree

        # The last one is the middle of the cap on the wrist.
        distance, index = cKDTree(wanted).query(found[:-1])
        assert distance.max() < 1e-5
        assert set(index) == set(range(len(wanted)))


def test_the_mesh_of_a_skinned_hand_is_read_by_trimesh(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    path = tmp_path / "hand.glb"
    export(avatar, path, ExportSettings(mesh=True, texture=256))
    scene = trimesh.load(path)
    (mesh,) = scene.geometry.values()
    template = avatar.model.rigs["right"].template
    border = trimesh.Trimesh(template.vertices, template.faces, process=False).outline().length
    assert border > 0.05
    image = np.asarray(mesh.visual.material.baseColorTexture)
    assert image.shape == (256, 256, 3)
    # The cap closes the wrist, and the whole surface has one outside.
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 1e-4 < mesh.volume < 1e-3


@pytest.mark.slow
def test_khronos_finds_no_error_in_a_mesh(fitted, tmp_path: Path) -> None:
    avatar, capture = fitted
    export(avatar, tmp_path / "hand.glb", ExportSettings(mesh=True, texture=256), capture=capture)
    assert validation_errors(tmp_path / "hand.glb") == []


def test_a_motion_has_the_times_of_its_frames(fitted) -> None:
    avatar, capture = fitted
    times = np.cumsum(np.resize([0.033, 0.067, 0.035], len(capture))) - 0.033
    info = replace(capture.info, times=tuple(times))
    uneven = Capture(capture.root, info, capture.hands, capture.cameras)
    kept = np.flatnonzero(capture.hands["right"].valid)
    motion = capture_motion(avatar, uneven, ("right",))
    np.testing.assert_allclose(motion.times, times[kept] - times[kept[0]])


def test_quaternions_do_not_jump_and_weights_sum_to_one() -> None:
    angles = np.linspace(0.0, 4.0 * np.pi, 100)[:, None] * [0.0, 0.0, 1.0]
    found = quaternions(angles)
    assert (found[1:] * found[:-1]).sum(axis=1).min() > 0.9
    np.testing.assert_allclose(
        Rotation.from_quat(found).as_matrix(), Rotation.from_rotvec(angles).as_matrix(), atol=1e-12
    )
    weights = np.random.default_rng(0).random((20, 16))
    numbers, shares = strongest(weights / weights.sum(axis=1, keepdims=True))
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-6)
    assert all(
        set(row) == set(np.argsort(-own)[:4]) for row, own in zip(numbers, weights, strict=True)
    )


def test_the_command_writes_each_format_and_refuses_the_rest(
    fitted, tmp_path: Path, capsys
) -> None:
    avatar, _ = fitted
    folder = tmp_path / "avatar"
    save_avatar(avatar, folder)
    for suffix in FORMATS:
        target = tmp_path / f"hand{suffix}"
        assert main(["export", str(folder), "-o", str(target), "--json"]) == 0
        count = len(with_walls(avatar))
        assert json.loads(capsys.readouterr().out) == {"file": str(target), "gaussians": count}
        assert target.stat().st_size > 1000
    refused = (
        (["-o", str(tmp_path / "hand.obj")], ".spz"),
        (["-o", str(tmp_path / "hand.ply")], "--overwrite"),
        (["-o", str(tmp_path / "m.ply"), "--mesh"], ".glb"),
        (["-o", str(tmp_path / "m.glb"), "--supersplat"], ".ply"),
        (["-o", str(tmp_path / "m.ply"), "--scale", "0"], "above 0"),
        (["-o", str(tmp_path / "m.ply"), "--frame", "3"], "--poses"),
        (["-o", str(tmp_path / "m.ply"), "--harmonics", "4"], "0 to 3"),
        (["-o", str(tmp_path / "m.glb"), "--mesh", "--texture", "9"], "64 to 4096"),
        (["-o", str(tmp_path / "m.glb"), "--mesh", "--harmonics", "0"], "--harmonics: is of"),
        (["-o", str(tmp_path / "m.glb"), "--texture", "64"], "--texture: is of a mesh"),
        (["-o", str(tmp_path / "m.ply"), "--scale", "1e40"], "infinite"),
    )
    for words, text in refused:
        assert main(["export", str(folder), *words]) == 2, words
        assert text in capsys.readouterr().err, words
    # Nothing is left of what was refused.
    assert not (tmp_path / "m.ply").exists()
    overwritten = ["export", str(folder), "-o", str(tmp_path / "hand.ply"), "--overwrite"]
    assert main(overwritten) == 0


def test_an_exported_scale_changes_lengths_alone(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    export(avatar, tmp_path / "a.ply", ExportSettings(scale=100.0))
    found, own = read_ply(tmp_path / "a.ply"), with_walls(avatar)
    np.testing.assert_allclose(found.means, 100.0 * own.means, rtol=1e-4, atol=1e-4)
    same_turns(found.quats, own.quats, 1e-5)
    assert replace(scaled(own, 1.0), colors=own.colors).colors is own.colors


def harmonics_of_ply(path: Path) -> np.ndarray:
    """(N, 16, 3) of a PLY in the layout of 3DGS: channel by channel."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if "property" in line]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    constant = table[:, names.index("f_dc_0") :][:, None, :3]
    rest = table[:, names.index("f_rest_0") :][:, :45].reshape(-1, 3, 15)
    return np.concatenate([constant, rest.transpose(0, 2, 1)], axis=1)


def read_spz(path: Path) -> tuple[PosedGaussians, np.ndarray]:
    """SPZ, version 3, by Niantic's description of the format."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, _, _ = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, degree) == (0x5053474E, 3, 3)
    whole = np.frombuffer(data[16:], np.uint8)
    parts = np.split(whole, np.cumsum([9 * count, count, 3 * count, 3 * count, 4 * count]))
    low = parts[0].reshape(count, 3, 3).astype(np.int64) @ [1, 1 << 8, 1 << 16]
    means = (low - np.where(low >= 1 << 23, 1 << 24, 0)) / 2.0**bits
    packed = parts[4].view("<u4")
    largest, quats = packed >> 30, np.zeros((count, 4))
    for component in (3, 2, 1, 0):
        here = component != largest
        size = (packed & 511) / 511.0 / np.sqrt(2.0)
        quats[here, component] = np.where(packed & 512, -size, size)[here]
        packed = np.where(here, packed >> 10, packed)
    rows = np.arange(count)
    quats[rows, largest] = np.sqrt((1.0 - (quats**2).sum(axis=1)).clip(min=0.0))
    constant = (parts[2].reshape(count, 1, 3) / 255.0 - 0.5) / 0.15
    others = (parts[5].reshape(count, 15, 3) - 128.0) / 128.0
    splats = PosedGaussians(
        means,
        np.roll(quats, 1, axis=1),
        np.exp(parts[3].reshape(count, 3) / 16.0 - 10.0),
        parts[1] / 255.0,
        0.5 + SH_CONSTANT * constant[:, 0],
    )
    return splats, np.concatenate([constant, others], axis=1)


def test_points_of_a_glb_have_linear_colors() -> None:
    """Oracle: the specification of glTF, and scikit-image's curve of sRGB."""
    splats = some_splats()
    made = pygltflib.GLTF2.load_from_bytes(splat_glb_bytes(splats, even(splats), "test"))
    found = attribute(made, "COLOR_0")
    expected = rgb2xyz(splats.colors.astype(np.float64))
    np.testing.assert_allclose(found[:, :3] @ xyz_from_rgb.T, expected, atol=1e-4)
    np.testing.assert_allclose(found[:, 3], splats.opacities, atol=1e-6)


def read_splat_glb(path: Path) -> tuple[PosedGaussians, np.ndarray]:
    made, prefix = pygltflib.GLTF2().load(str(path)), "KHR_gaussian_splatting:"
    names = [f"SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)]
    harmonics = np.stack([attribute(made, prefix + name) for name in names], axis=1)
    splats = PosedGaussians(
        attribute(made, "POSITION"),
        np.roll(attribute(made, f"{prefix}ROTATION"), 1, axis=1),
        attribute(made, f"{prefix}SCALE"),
        attribute(made, f"{prefix}OPACITY")[:, 0],
        0.5 + SH_CONSTANT * harmonics[:, 0],
    )
    return splats, harmonics


def seen_color(harmonics: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours from (N, 16, 3) harmonics in a direction, by SciPy's spherical harmonics."""
    from scipy.special import sph_harm_y

    x, y, z = directions.T
    polar, azimuth = np.arccos(z.clip(-1.0, 1.0)), np.arctan2(y, x)
    color = np.full((len(x), 3), 0.5)
    for degree in range(4):
        for order in range(-degree, degree + 1):
            whole = sph_harm_y(degree, abs(order), polar, azimuth)
            # Real harmonics with the sign of Condon and Shortley, as 3DGS has them.
            part = whole.imag if order < 0 else whole.real
            value = part * (np.sqrt(2.0) if order else 1.0)
            color += value[:, None] * harmonics[:, degree**2 + degree + order]
    return color.clip(min=0.0)


def splatted(
    splats: PosedGaussians,
    harmonics: np.ndarray,
    place: tuple[np.ndarray, np.ndarray],
    camera: Camera,
) -> np.ndarray:
    """(H, W, 3) over black: EWA splatting, Gaussian by Gaussian, in NumPy.

    Args:
        splats, harmonics: of a file.
        place: rotation and shift from the file to the world of the camera.
        camera: the viewer's.
    """
    view = camera.viewmat[:3, :3] @ place[0]
    points = splats.means.astype(np.float64) @ view.T
    points += camera.viewmat[:3, :3] @ place[1] + camera.viewmat[:3, 3]
    away = points / np.linalg.norm(points, axis=1, keepdims=True)
    colors = seen_color(harmonics, away @ view)
    half = view @ turns(splats.quats) * splats.scales[:, None].astype(np.float64)
    image = np.zeros((camera.height, camera.width, 3))
    clear = np.ones((camera.height, camera.width))
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    (fx, _, cx), (_, fy, cy) = camera.K[:2]
    for index in np.argsort(points[:, 2]):
        x, y, z = points[index]
        slope = np.array([[fx / z, 0.0, -fx * x / z**2], [0.0, fy / z, -fy * y / z**2]])
        # 3DGS blurs by 0.3 px^2.
        covariance = slope @ half[index] @ half[index].T @ slope.T + 0.3 * np.eye(2)
        a, b, c = np.linalg.inv(covariance)[[0, 0, 1], [0, 1, 1]]
        dx, dy = columns - (fx * x / z + cx), rows - (fy * y / z + cy)
        power = np.exp(-0.5 * (a * dx**2 + 2.0 * b * dx * dy + c * dy**2))
        alpha = (splats.opacities[index] * power).clip(max=0.999)
        alpha = np.where(alpha < 1.0 / 255.0, 0.0, alpha)
        image += (clear * alpha)[..., None] * colors[index]
        clear = clear * (1.0 - alpha)
    return image.clip(0.0, 1.0)


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.square(image - other).mean() + 1e-12))


def box(rgba: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.nonzero(rgba[..., 3] > 0.5)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb"])
def test_a_file_is_drawn_as_the_avatar_draws_itself(
    fitted, tmp_path: Path, suffix: str, posed: bool
) -> None:
    """At least 40 dB in the hand's box, where it is hardest, from the camera of the frame, or from
    the studio's; read and drawn by code of its own."""
    avatar, capture = copy.deepcopy(fitted[0]), fitted[1]
    # Skin that no frame shows is drawn otherwise from behind, which a file cannot.
    avatar.model.keep(avatar.model.visibility.spare_all())
    path = tmp_path / f"hand{suffix}"
    if posed:
        export(avatar, path, capture=capture, frame=7)
        wanted = avatar.render(capture.hand_poses(7), camera := capture.camera(7))
        place = (np.eye(3) if suffix == ".ply" else np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    else:
        export(avatar, path)
        wanted = avatar.render(avatar.studio.posed(), camera := avatar.studio.camera(64, 64))
        turn, shift = to_rest(avatar)
        place = (turn.T, -turn.T @ shift)
    read = {".spz": read_spz, ".glb": read_splat_glb}
    given = read[suffix](path) if suffix in read else (read_ply(path), harmonics_of_ply(path))
    drawn = splatted(*given, place, camera)
    assert psnr(drawn[box(wanted)], wanted[box(wanted)][..., :3]) >= 40.0


def test_a_file_seen_from_behind_is_the_turntables_back(fitted, tmp_path: Path) -> None:
    """The hand turned half around, under the light that stands in front of it. The rest is what
    Gaussians that change their shape with the side cannot keep. One color each is worse."""
    avatar, _ = fitted
    camera, reached = avatar.studio.camera(64, 64), {}
    hands = avatar.studio.posed(turn=180.0)
    wanted = avatar.render(hands, camera)
    place = motion_between(
        vertices_of(avatar, avatar.rest_poses()["right"]), vertices_of(avatar, hands["right"])
    )
    for degree in (0, 3):
        path = tmp_path / f"{degree}.ply"
        export(avatar, path, ExportSettings(harmonics=degree))
        found = read_ply(path)
        own = harmonics_of_ply(path) if degree else np.zeros((len(found), 16, 3))
        own[:, 0] = (found.colors - 0.5) / SH_CONSTANT
        reached[degree] = psnr(splatted(found, own, place, camera), wanted[..., :3])
    assert reached[3] > 30.0
    assert reached[3] > reached[0]


def test_a_mesh_is_drawn_from_the_front_as_the_turntable(fitted, tmp_path: Path) -> None:
    """Rays from the camera meet the mesh of the file and read its texture. Where both show the hand
    they differ by the shape that Gaussians have and a mesh has not, and by the sides' light."""
    avatar, _ = fitted
    export(avatar, tmp_path / "hand.glb", ExportSettings(mesh=True, texture=256))
    (mesh,) = trimesh.load(tmp_path / "hand.glb").geometry.values()
    hands, camera = avatar.studio.posed(), avatar.studio.camera(96, 96)
    wanted = avatar.render(hands, camera)
    turn, shift = to_rest(avatar)
    columns, rows = np.meshgrid(np.arange(96) + 0.5, np.arange(96) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3)
    rays = rays @ np.linalg.inv(camera.K).T
    moved = trimesh.Trimesh((mesh.vertices - shift) @ turn, mesh.faces, process=False)
    places, ray, face = moved.ray.intersects_location(
        np.zeros_like(rays), rays, multiple_hits=False
    )
    mix = trimesh.triangles.points_to_barycentric(moved.triangles[face], places)
    uv = (mesh.visual.uv[mesh.faces[face]] * mix[..., None]).sum(axis=1)
    drawn = mesh.visual.material.to_color(uv)[:, :3] / 255.0
    shown = wanted.reshape(-1, 4)[ray]
    whole = shown[:, 3] > 0.99
    assert whole.sum() > 500
    assert psnr(drawn[whole], shown[whole, :3]) > 24.0


def test_numbers_that_are_not_finite_are_never_written(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    bias = avatar.model.network.attribute_head.attributes.bias
    kept = bias.detach().clone()
    try:
        with torch.no_grad():
            bias.fill_(torch.nan)
        for suffix in FORMATS:
            with pytest.raises(BadInput, match="NaN or infinite"):
                export(avatar, tmp_path / f"hand{suffix}")
        with pytest.raises(BadInput, match="NaN or infinite"):
            wildghand.page.write_page(avatar, tmp_path / "page.html")
    finally:
        with torch.no_grad():
            bias.copy_(kept)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(BadInput, match="NaN or infinity"):
        GlbBuilder("test").array(np.array([np.inf], dtype=np.float32))


def test_a_file_that_another_process_made_meanwhile_is_kept(
    fitted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, _ = fitted
    target = tmp_path / "hand.ply"
    scale = scaled

    def slower(splats: PosedGaussians, factor: float) -> PosedGaussians:
        target.write_text("of another process")
        return scale(splats, factor)

    monkeypatch.setattr("wildghand.export.formats.scaled", slower)
    with pytest.raises(UsageError, match=r"exists already.*--overwrite"):
        export(avatar, target)
    assert target.read_text() == "of another process"
    assert [path.name for path in tmp_path.iterdir()] == [target.name]
    export(avatar, target, overwrite=True)
    assert target.stat().st_size > 1000
