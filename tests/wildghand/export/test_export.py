"""Exported avatars. Oracles: splat-transform (whose SPZ codec is Niantic's), pygltflib, trimesh,
the Khronos validator, an implementation of glTF's skinning, and the avatar's own Gaussians."""

from __future__ import annotations

import io
import json
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
from splat_transform import transform, validation_errors
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import pose_hand
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.files import save_avatar
from wildghand.cli.main import main
from wildghand.export.formats import FORMATS, ExportSettings, export
from wildghand.export.placing import half_turned, scaled
from wildghand.export.ply import SH_CONSTANT, ply_bytes
from wildghand.export.skinned_glb import quaternions, strongest
from wildghand.export.spz import FRACTIONAL_BITS, packed_rotations, spz_bytes
from wildghand.export.texture import baked


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    capture = make_painted()
    return wildghand.fit(capture.root, settings=TINY, steps=2, all_frames=True), capture


def read_ply(path: Path) -> PosedGaussians:
    """A reader of its own: the properties by the names in the header."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    column = dict(zip(names, table.T, strict=True))

    def stacked(*keys: str) -> np.ndarray:
        return np.stack([column[key] for key in keys], axis=1)

    return PosedGaussians(
        means=stacked("x", "y", "z"),
        quats=stacked("rot_0", "rot_1", "rot_2", "rot_3"),
        scales=np.exp(stacked("scale_0", "scale_1", "scale_2")),
        opacities=1.0 / (1.0 + np.exp(-column["opacity"])),
        colors=0.5 + SH_CONSTANT * stacked("f_dc_0", "f_dc_1", "f_dc_2"),
    )


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


def with_walls(avatar: WildGHandAvatar) -> PosedGaussians:
    """The Gaussians of an avatar at rest, its wrist closed as in its pictures."""
    closed = avatar.pose(avatar.rest_poses(), closed=True)
    own = avatar.gaussians
    assert len(own) == 300
    assert len(closed) > 300
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_array_equal(getattr(closed, name)[:300], getattr(own, name))
    return closed


def test_a_ply_holds_the_avatars_gaussians_and_says_its_unit(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    path = tmp_path / "hand.ply"
    wanted = with_walls(avatar)
    assert export(avatar, path) == {"gaussians": len(wanted)}
    assert b"comment 1 units are a metre\n" in path.read_bytes()
    found = read_ply(path)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6, err_msg=name
        )
    # trimesh reads it as a cloud of points.
    cloud = trimesh.load(io.BytesIO(path.read_bytes()), file_type="ply")
    np.testing.assert_allclose(cloud.vertices, wanted.means, atol=1e-6)


def test_a_pose_of_a_capture_is_exported(fitted, tmp_path: Path) -> None:
    avatar, capture = fitted
    export(avatar, tmp_path / "hand.ply", capture=capture, frame=7)
    wanted = avatar.pose(capture.hand_poses(7), closed=True)
    np.testing.assert_allclose(read_ply(tmp_path / "hand.ply").means, wanted.means, atol=1e-6)
    assert b"comment y is down" in (tmp_path / "hand.ply").read_bytes()


def test_supersplat_gets_its_axes_and_size(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    export(avatar, tmp_path / "hand.ply", ExportSettings(supersplat=True))
    found, own = read_ply(tmp_path / "hand.ply"), with_walls(avatar)
    np.testing.assert_allclose(found.means, 10.0 * own.means * [1, -1, -1], atol=1e-5)
    np.testing.assert_allclose(found.scales, 10.0 * own.scales, rtol=1e-4)
    # The axes of the Gaussians turn with them.
    np.testing.assert_allclose(
        turns(found.quats), np.diag([1.0, -1.0, -1.0]) @ turns(own.quats), atol=1e-5
    )


@pytest.mark.slow
def test_an_spz_is_read_by_niantics_codec(tmp_path: Path) -> None:
    """Tolerances are half a step of each number: 24 bits with 17 behind the point, 8 bits of
    opacity, colour (of 1 / (255 * 0.15)) and log scale (1 / 16), 9 bits and a sign of a turn."""
    splats = some_splats()
    source = tmp_path / "hand.spz"
    source.write_bytes(spz_bytes(splats))
    assert source.read_bytes() == spz_bytes(splats)
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
        spz_bytes(scaled(some_splats(3), 1000.0))


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
    from wildghand.export.splat_glb import EXTENSION, splat_glb_bytes

    splats = some_splats()
    mine, theirs = tmp_path / "mine.glb", tmp_path / "theirs.glb"
    mine.write_bytes(splat_glb_bytes(half_turned(splats), "test"))
    (tmp_path / "hand.ply").write_bytes(ply_bytes(splats))
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
    counts = export(avatar, path, ExportSettings(mesh=True), capture=given)
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

        distance, index = cKDTree(wanted).query(found)
        assert distance.max() < 1e-5
        assert set(index) == set(range(len(wanted)))


def test_the_mesh_of_a_skinned_hand_is_read_by_trimesh(fitted, tmp_path: Path) -> None:
    avatar, _ = fitted
    path = tmp_path / "hand.glb"
    export(avatar, path, ExportSettings(mesh=True))
    scene = trimesh.load(path)
    (mesh,) = scene.geometry.values()
    template = avatar.model.rigs["right"].template
    assert len(mesh.faces) == len(template.faces)
    image = np.asarray(mesh.visual.material.baseColorTexture)
    assert image.shape == (512, 512, 3)
    # trimesh counts v from the bottom again: the texture read at an anchor is its Gaussian's.
    colors = mesh.visual.material.to_color(mesh.visual.uv)[:, :3] / 255.0
    own = avatar.gaussians.colors.clip(0.0, 1.0)
    assert np.abs(colors.mean(axis=0) - own.mean(axis=0)).max() < 0.05


@pytest.mark.slow
def test_khronos_finds_no_error_in_a_mesh(fitted, tmp_path: Path) -> None:
    avatar, capture = fitted
    export(avatar, tmp_path / "hand.glb", ExportSettings(mesh=True), capture=capture)
    assert validation_errors(tmp_path / "hand.glb") == []


def test_a_texture_has_the_color_of_the_gaussian_there() -> None:
    uv = np.array([[0.25, 0.75], [0.75, 0.25]])
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    image = baked(uv, colors, np.ones(2), 64)
    # Row 0 is the top, v = 1; each texel there is of its Gaussian but for a share of the other.
    assert np.abs(image[16, 16].astype(int) - [255, 0, 0]).max() < 3
    assert np.abs(image[48, 48].astype(int) - [0, 0, 255]).max() < 3


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
    np.testing.assert_allclose(found.quats, own.quats, atol=1e-6)
    assert replace(scaled(own, 1.0), colors=own.colors).colors is own.colors
