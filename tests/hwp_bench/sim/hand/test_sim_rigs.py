"""Rigged glTF hands of any topology: open or closed at the wrist, with holes, a forearm, in parts.

Oracle: all are made from the free hand, so that its joints, its wrist and its surface are known.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pygltflib
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.rig_files import (
    Piece,
    boxes,
    capped,
    halves,
    remeshed,
    split_at_seams,
    with_forearm,
    without_nails,
    write_rig,
)
from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.hand.rigs import (
    FARTHEST_BEFORE,
    FARTHEST_BEHIND,
    WEBXR,
    components,
    hand_joints,
    load_rig,
    outlines,
    rig_path,
)
from hwp_bench.sim.produce.capture import RENDERER, render_key
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.subject import hand
from hwp_bench.sim.subject.subject import Glove, Looks, Subject

#: The joints as OpenXR rigs name them, without the side's suffix.
OPENXR = (
    "Wrist",
    *(
        f"{finger}_{part}"
        for finger in ("Index", "Middle", "Little", "Ring")
        for part in ("Proximal", "Intermediate", "Distal")
    ),
    *("Thumb_Metacarpal", "Thumb_Proximal", "Thumb_Distal"),
)


def write_gltf(path: Path, template: HandTemplate, names: tuple[str, ...]) -> Path:
    """Write a template as a binary glTF, its vertices split along the seams."""
    return write_rig(path, [split_at_seams(template)], names, template=template)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("scheme", ["webxr", "openxr"])
def test_a_rig_becomes_the_hand_that_it_was(tmp_path: Path, scheme: str, side: str) -> None:
    names = WEBXR if scheme == "webxr" else tuple(f"{name}_R" for name in OPENXR)
    path = write_gltf(tmp_path / "hand.glb", load_template("anny", "right"), names)
    model = load_template("anny", side)
    rig, texture = load_rig(str(path), side, model)
    assert texture is None
    assert rig.side == side
    np.testing.assert_allclose(rig.joints, model.joints, atol=1e-5)
    # Same vertices in another order: nearest neighbours, and the welded count.
    from scipy.spatial import cKDTree

    distance, pick = cKDTree(model.vertices).query(rig.vertices)
    assert len(rig.vertices) == len(model.vertices)
    assert distance.max() < 1e-5
    assert np.abs(rig.weights - model.weights[pick]).max() < 0.05
    np.testing.assert_allclose(
        rig.vertices[rig.fingertips], model.vertices[model.fingertips], atol=0.006
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_rig_that_ships_is_another_hand(side: str) -> None:
    path = rig_path("rig:generic-hand")
    assert path is not None
    model = load_template("anny", side)
    rig, texture = load_rig(path, side, model)
    assert texture is None
    assert rig.side == side
    assert len(rig.vertices) != len(model.vertices)
    # As large as the hand model, but no shape of it: the bones have other lengths.
    spans = [np.ptp(one.vertices, axis=0).max() for one in (rig, model)]
    assert spans[0] == pytest.approx(spans[1], rel=0.25)
    assert np.linalg.norm(rig.joints - model.joints, axis=1).max() > 0.003
    licence = Path(path).with_name("generic-hand.LICENSE.txt").read_text("utf-8")
    assert "MIT License" in licence


def test_models_without_a_rig_and_unknown_rigs() -> None:
    assert rig_path("anny") is None
    assert rig_path("gltf:some/hand.glb") == "some/hand.glb"
    with pytest.raises(UsageError, match="generic-hand"):
        rig_path("rig:nobody")


@pytest.mark.usefixtures("small_paintings")
def test_a_scene_shows_the_rig(tmp_path: Path, make_scene: Callable[..., Scene]) -> None:
    path = write_gltf(tmp_path / "hand_right.glb", load_template("anny", "right"), WEBXR)
    scene = make_scene(("age = 31.0", f'age = 31.0\nmodel = "gltf:{path}"'))
    result = render_frame(scene, 36, 40, 48)
    own = render_frame(make_scene(), 36, 40, 48)
    both = (result.coverage > 0.5) & (own.coverage > 0.5)
    either = (result.coverage > 0.5) | (own.coverage > 0.5)
    # The subject's shape is not the rig's, but the pose is.
    assert both.sum() / either.sum() > 0.7


def test_gloves_on_a_rig_with_a_texture_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, white = hand.load_rig, np.full((4, 4, 3), 255, np.uint8)
    monkeypatch.setattr(hand, "load_rig", lambda *given: (rig(*given)[0], white))
    hand.subject_hand.cache_clear()
    looks = Looks(gloves=(Glove("work"),))
    worn = Subject(seed=1, tone=0.3, age=30.0, model="rig:generic-hand", looks=looks)
    try:
        with pytest.raises(BadHandModel, match=r"subject\.looks\.gloves"):
            hand.subject_hand(worn, "right")
    finally:
        hand.subject_hand.cache_clear()


def test_another_rig_in_the_same_place_is_another_render(
    tmp_path: Path, make_scene: Callable[..., Scene]
) -> None:
    # The buffer lies in a file of its own, and only that one changes.
    rig = pygltflib.GLTF2().load(str(rig_path("rig:generic-hand")))
    (tmp_path / "hand.bin").write_bytes(rig.binary_blob())
    rig.buffers[0].uri = "hand.bin"
    rig.save_json(str(tmp_path / "hand.gltf"))
    scene = make_scene(("age = 31.0", f'age = 31.0\nmodel = "gltf:{tmp_path / "hand.gltf"}"'))
    before = render_key(scene, 10, 48)
    assert render_key(scene, 10, 48) == before
    with (tmp_path / "hand.bin").open("ab") as file:
        file.write(b"\0")
    assert render_key(scene, 10, 48) != before


def test_names_of_files_may_be_encoded(tmp_path: Path) -> None:
    rig = pygltflib.GLTF2().load(str(rig_path("rig:generic-hand")))
    (tmp_path / "my hand.bin").write_bytes(rig.binary_blob())
    model, file = load_template("anny", "right"), tmp_path / "hand.gltf"
    shipped, _ = load_rig(str(rig_path("rig:generic-hand")), "right", model)
    for name in ("my%20hand.bin", "my hand.bin"):
        rig.buffers[0].uri = name
        rig.save_json(str(file))
        np.testing.assert_array_equal(
            load_rig(str(file), "right", model)[0].vertices, shipped.vertices
        )


def test_what_ships_keeps_its_key(make_scene: Callable[..., Scene]) -> None:
    # Oracle: the definition. Captures in caches are found by it.
    for model in ("anny", "rig:generic-hand"):
        scene = make_scene(("age = 31.0", f'age = 31.0\nmodel = "{model}"'))
        assert render_key(scene, 10, 48) == sha256_json([RENDERER, scene.digest, 10, 48])


def test_missing_joints_are_named(tmp_path: Path) -> None:
    names = (*WEBXR[:5], "tentacle", *WEBXR[6:])
    path = write_gltf(tmp_path / "hand.glb", load_template("anny", "right"), names)
    with pytest.raises(BadHandModel, match=WEBXR[5]):
        load_rig(str(path), "right", load_template("anny", "right"))
    with pytest.raises(BadHandModel, match="does not exist"):
        load_rig(str(tmp_path / "none.glb"), "right", load_template("anny", "right"))


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_damaged_files_are_refused_or_read(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("rig")
    model = load_template("anny", "right")
    path = write_gltf(folder / "hand.glb", model, WEBXR)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, 4000))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(100, len(raw)))])
    try:
        rig, _ = load_rig(str(path), "right", model)
    except BadHandModel:
        return
    assert np.isfinite(rig.vertices).all()


KINDS = ("remeshed", "closed", "nails", "closed nails", "forearm", "parts", "meshes", "boxes")


@pytest.fixture(scope="module")
def free() -> HandTemplate:
    return load_template("anny", "right")


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory, free: HandTemplate) -> dict[str, Path]:
    """One file of each kind."""
    folder = tmp_path_factory.mktemp("rigs")
    fine = remeshed(free)
    elbow = (("forearm", (0.25, 0.0, 0.0)),)
    nails = without_nails(fine, free)
    two = halves(split_at_seams(free))
    return {
        "remeshed": write_rig(folder / "remeshed.glb", [fine]),
        "closed": write_rig(folder / "closed.glb", [capped(fine)]),
        "nails": write_rig(folder / "nails.glb", [nails]),
        "closed nails": write_rig(folder / "both.glb", [capped_wrist(nails)]),
        "forearm": write_rig(folder / "arm.glb", [with_forearm(fine)], more_joints=elbow),
        "parts": write_rig(folder / "parts.glb", two),
        "meshes": write_rig(folder / "meshes.glb", two, layout="meshes"),
        "boxes": write_rig(folder / "boxes.glb", [boxes(free)]),
    }


def capped_wrist(piece: Piece) -> Piece:
    """Closed at the wrist, though holes elsewhere have longer outlines."""
    behind = [loop for loop in outlines(piece.faces) if piece.vertices[loop, 0].min() > 0]
    (rim,) = behind
    fan = np.stack([np.roll(rim, -1), rim, np.full(len(rim), len(piece.vertices))], axis=1)
    return Piece(
        np.vstack([piece.vertices, piece.vertices[rim].mean(axis=0)]),
        np.vstack([piece.faces, fan]),
        np.vstack([piece.weights, piece.weights[rim].mean(axis=0)]),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_the_only_opening_is_the_wrist(
    rigs: dict[str, Path], free: HandTemplate, kind: str
) -> None:
    rig, _ = load_rig(str(rigs[kind]), "right", free)
    (rim,) = outlines(rig.faces)
    assert set(rim.tolist()) == set(boundary_loop(rig.faces).tolist())
    along = rig.vertices[rim, 0] - rig.joints[0, 0]
    assert -FARTHEST_BEFORE <= along.mean() <= FARTHEST_BEHIND
    # Around the arm: on all four sides of the joint.
    offset = rig.vertices[rim] - rig.joints[0]
    assert offset[:, 1:].min(axis=0).max() < -0.008
    assert offset[:, 1:].max(axis=0).min() > 0.008
    # Nothing of the arm is left behind the sleeve's beginning, and the fingers are all there.
    assert rig.vertices[:, 0].max() < 0.03
    np.testing.assert_allclose(rig.joints, free.joints, atol=2e-3)
    np.testing.assert_allclose(
        rig.vertices[rig.fingertips], free.vertices[free.fingertips], atol=0.012
    )


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "boxes"])
def test_the_surface_is_the_one_that_was_written(
    rigs: dict[str, Path], free: HandTemplate, kind: str
) -> None:
    # Every vertex but the caps' lies on the free hand; tolerance 0.1 mm for splits off its edges.
    import trimesh

    rig, _ = load_rig(str(rigs[kind]), "right", free)
    hand = trimesh.Trimesh(free.vertices, free.faces, process=False)
    centers = np.asarray(hand.triangles_center)
    from scipy.spatial import cKDTree

    _, near = cKDTree(centers).query(rig.vertices, k=12)
    points = np.repeat(rig.vertices, 12, axis=0)
    nearest = trimesh.triangles.closest_point(hand.triangles[near.ravel()], points)
    distance = np.linalg.norm(nearest - points, axis=1).reshape(-1, 12).min(axis=1)
    assert (distance > 1e-4).mean() < 0.05
    assert len(np.unique(components(rig.faces, len(rig.vertices)))) == 1
    assert np.isfinite(rig.vertices).all()
    # Skin can be painted: triangles cover the sheet without covering one another.
    corners = rig.uv[rig.face_uv]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    image = np.zeros((512, 512), dtype=np.uint8)
    for corner in np.round(corners * 511 * 16).astype(np.int32):
        cv2.fillConvexPoly(image, corner, 1, shift=4)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
    assert 0.02 < area < 1.15 * image.mean()
    np.testing.assert_allclose(rig.weights.sum(axis=1), 1.0, atol=1e-9)


@pytest.mark.usefixtures("small_paintings")
@pytest.mark.parametrize("kind", ["closed", "nails", "forearm", "meshes", "boxes"])
def test_a_scene_shows_one_hand_and_a_sleeve(
    rigs: dict[str, Path], make_scene: Callable[..., Scene], kind: str
) -> None:
    scene = make_scene(("age = 31.0", f'age = 31.0\nmodel = "gltf:{rigs[kind]}"'))
    shown = render_frame(scene, 36, 40, 48).coverage
    count, labels = cv2.connectedComponents((shown > 0.5).astype(np.uint8))
    sizes = np.bincount(labels.ravel(), minlength=count)[1:]
    assert sizes.max() >= 0.98 * sizes.sum() > 60
    own = render_frame(make_scene(), 36, 40, 48).coverage
    both = ((shown > 0.5) & (own > 0.5)).sum() / ((shown > 0.5) | (own > 0.5)).sum()
    assert both > 0.6


@pytest.mark.parametrize("form", ["sparse", "two sets", "loose"])
def test_forms_of_a_file_mean_the_same(tmp_path: Path, free: HandTemplate, form: str) -> None:
    piece = split_at_seams(free)
    form_path = write_rig(tmp_path / "hand.glb", [piece], form=form)
    rig, _ = load_rig(str(form_path), "right", free)
    plain, _ = load_rig(str(write_rig(tmp_path / "plain.glb", [piece])), "right", free)
    np.testing.assert_allclose(rig.vertices, plain.vertices, atol=1e-5)
    np.testing.assert_array_equal(rig.faces.shape, plain.faces.shape)
    if form == "two sets":
        # Eight weights a vertex are closer to the free hand's than four.
        assert np.abs(rig.weights - plain.weights).max() < 0.05


def test_nodes_place_a_mesh_without_bind_matrices(tmp_path: Path, free: HandTemplate) -> None:
    path = write_rig(tmp_path / "hand.glb", [split_at_seams(free)], layout="posed")
    rig, _ = load_rig(str(path), "right", free)
    np.testing.assert_allclose(rig.joints, free.joints, atol=1e-4)
    assert np.abs(np.sort(rig.vertices, axis=0) - np.sort(free.vertices, axis=0)).max() < 1e-3


def _named(pattern: str, fingers: str, numbers: tuple[str, ...], wrist: str) -> tuple[str, ...]:
    return (
        wrist,
        *(pattern.format(f=f, n=n) for f in fingers.split() for n in numbers),
    )


@pytest.mark.parametrize(
    ("names", "side"),
    [
        (
            _named(
                "mixamorig:RightHand{f}{n}",
                "Index Middle Pinky Ring Thumb",
                ("1", "2", "3"),
                "mixamorig:RightHand",
            ),
            "right",
        ),
        (
            _named("left_{f}{n}", "index middle pinky ring thumb", ("1", "2", "3"), "left_wrist"),
            "left",
        ),
        (
            _named("{f}_{n}_r", "index middle pinky ring thumb", ("01", "02", "03"), "hand_r"),
            "right",
        ),
        (
            _named(
                "DEF-f_{f}.{n}.L", "index middle pinky ring thumb", ("01", "02", "03"), "DEF-hand.L"
            ),
            "left",
        ),
        (
            _named("finger_{f}_{n}_r", "index middle pinky ring thumb", ("0", "1", "2"), "wrist_r"),
            "right",
        ),
        (
            _named(
                "right{f}{n}",
                "Index Middle Little Ring Thumb",
                ("Proximal", "Intermediate", "Distal"),
                "rightHand",
            ),
            "right",
        ),
        (_named("{f}{n}", "index middle pinky ring thumb", ("1", "2", "3"), "wrist"), None),
    ],
)
def test_usual_names_are_understood(names: tuple[str, ...], side: str | None) -> None:
    # Beside joints of a body, tips, bones of the palm, and the other hand.
    other = [name.replace("Right", "Left").replace("right", "left") for name in names]
    aside = ["Hips", "Spine2", *(f"{name}_end" for name in names), *other]
    rows, told = hand_joints([*aside, *names], side or "right", "rig.glb")
    assert told == side
    first = len(aside) if other != list(names) else len(aside) - len(names)
    assert rows == list(range(first, first + 16))


def test_bones_of_the_palm_are_not_the_first_joints() -> None:
    names = ["b_r_wrist"]
    for finger in ("index", "middle", "pinky", "ring", "thumb"):
        names += [f"b_r_{finger}{number}" for number in (0, 1, 2, 3)]
    rows, told = hand_joints(names, "right", "rig.glb")
    assert told == "right"
    assert [names[row] for row in rows[1:4]] == [f"b_r_index{number}" for number in (1, 2, 3)]


def test_a_hand_is_taken_from_a_whole_body(tmp_path: Path, free: HandTemplate) -> None:
    # The body stands before the wrist's plane; only what its own joints move may go.
    import trimesh

    fine = with_forearm(remeshed(free))
    weights = np.hstack([fine.weights, np.zeros((len(fine.weights), 1))])
    body = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    torso = Piece(
        np.asarray(body.vertices) + np.array([-0.3, 0.5, 0.0]),
        np.asarray(body.faces),
        np.tile(np.eye(18)[17], (len(body.vertices), 1)),
    )
    names = _named(
        "mixamorig:RightHand{f}{n}",
        "Index Middle Pinky Ring Thumb",
        ("1", "2", "3"),
        "mixamorig:RightHand",
    )
    more = (("mixamorig:RightForeArm", (0.25, 0.0, 0.0)), ("mixamorig:Spine", (-0.3, 0.5, 0.0)))
    pieces = [Piece(fine.vertices, fine.faces, weights), torso]
    rig, _ = load_rig(
        str(write_rig(tmp_path / "a.glb", pieces, names, more_joints=more)), "right", free
    )
    assert len(np.unique(components(rig.faces, len(rig.vertices)))) == 1
    assert np.ptp(rig.vertices, axis=0).max() < 0.25


def test_what_has_no_wrist_is_one_message(tmp_path: Path, free: HandTemplate) -> None:
    fine = remeshed(free)
    front = fine.vertices[fine.faces].mean(axis=1)[:, 0] < -0.06
    path = write_rig(tmp_path / "hand.glb", [Piece(fine.vertices, fine.faces[front], fine.weights)])
    with pytest.raises(BadHandModel, match="before its wrist joint"):
        load_rig(str(path), "right", free)
    # A palm without its back: nothing runs around the wrist.
    below = fine.vertices[fine.faces].mean(axis=1)[:, 1] < -0.004
    path = write_rig(tmp_path / "half.glb", [Piece(fine.vertices, fine.faces[below], fine.weights)])
    with pytest.raises(BadHandModel, match="outline around its wrist"):
        load_rig(str(path), "right", free)


def test_skin_far_from_the_joints_is_one_message(tmp_path: Path, free: HandTemplate) -> None:
    piece = split_at_seams(free)
    far = Piece(piece.vertices + 2.0, piece.faces, piece.weights)
    with pytest.raises(BadHandModel, match="no skin near"):
        load_rig(str(write_rig(tmp_path / "hand.glb", [far])), "right", free)


def test_outlines_that_touch_are_told_apart() -> None:
    # Two squares of two triangles each that share a corner, and a triangle alone.
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 6], [7, 8, 9]])
    found = sorted(sorted(loop.tolist()) for loop in outlines(faces))
    assert found == [[0, 1, 2, 3], [0, 4, 5, 6], [7, 8, 9]]


def test_a_rest_pose_of_its_own_becomes_the_hand_models(tmp_path: Path, free: HandTemplate) -> None:
    # A relaxed bind pose: joints must come back, skin but for what blending costs.
    import torch

    from hwp_bench.hands import pose_hand
    from hwp_bench.hands.poses import finger_pose, gesture
    from hwp_bench.hands.template import rebuilt

    pose = np.vstack([np.zeros(3), 0.4 * finger_pose(gesture("fist"), free.joints)])
    zeros = torch.zeros(10, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    posed = pose_hand(free.to_torch(torch.float64), torch.tensor(pose)[None], *zeros)
    bent = rebuilt(
        free, vertices=posed.vertices[0].numpy(), joints=posed.joints[0].numpy(), name="bent"
    )
    path = write_rig(tmp_path / "hand.glb", [split_at_seams(bent)], template=bent)
    rig, _ = load_rig(str(path), "right", free)
    np.testing.assert_allclose(rig.joints, free.joints, atol=1e-3)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(free.vertices).query(rig.vertices)
    assert np.quantile(distance, 0.9) < 0.002
