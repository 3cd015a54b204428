"""The capture format: what is written is read, and what is damaged is named."""

from __future__ import annotations

import contextlib
import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker, cameras, hand_parameters, hand_picture

from hwp_bench.base.arrays import evenly, read_npz, write_npz
from hwp_bench.base.drawing import GAP, LABEL_HEIGHT, outlined
from hwp_bench.base.errors import (
    BadCapture,
    BadInput,
    EmptyMask,
    HwpError,
    ShapeMismatch,
    UsageError,
)
from hwp_bench.capture import Cameras, Capture, CaptureWriter, open_capture
from hwp_bench.capture.check import check_capture, contact_sheet, draw_hands, mesh_problems
from hwp_bench.capture.schema import read_subject_mesh, write_subject_mesh
from hwp_bench.cli.main import main
from hwp_bench.hands import HandTemplate, load_template, mirror_template
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.hands.template import rebuilt
from hwp_bench.metrics.score import score_frame


@pytest.mark.parametrize("hands", ["right", "left", "both"])
def test_a_capture_round_trips(make_capture: CaptureMaker, hands: str) -> None:
    capture = make_capture(hands=hands, frames=12, truth=True)
    picture, mask = hand_picture(7, 32)
    np.testing.assert_array_equal(capture.frame(7), picture)
    np.testing.assert_array_equal(capture.mask(7), mask)
    np.testing.assert_array_equal(capture.clean(7), picture)
    assert capture.scoring_mask(7)[1] is True
    assert set(capture.hands) == set(capture.info.sides)
    for index, side in enumerate(capture.info.sides):
        np.testing.assert_array_equal(capture.hands[side].pose, hand_parameters(12, index).pose)
        np.testing.assert_array_equal(capture.true_hands[side].betas, capture.hands[side].betas)
    assert capture.info.interacting == (hands == "both")
    report = check_capture(capture.root)
    assert report.ok
    assert report.findings == ()
    assert report.facts["truth"] == ["clean frames", "exact masks", "hand parameters"]


@pytest.mark.parametrize("kind", [np.float32, np.int64])
def test_cameras_of_other_types_are_read_as_written(
    make_capture: CaptureMaker, tmp_path: Path, kind: type
) -> None:
    info = make_capture(frames=10).info
    K = np.array([[29, 0, 16], [0, 29, 16], [0, 0, 1]], dtype=kind)
    track = Cameras(np.tile(K, (10, 1, 1)), np.tile(np.eye(4, dtype=kind), (10, 1, 1)))
    with CaptureWriter(tmp_path / "x", info, {"right": hand_parameters(10)}, track) as writer:
        for frame in range(10):
            picture, mask = hand_picture(frame, 32)
            writer.frame(frame, picture)
            writer.mask(frame, mask)
    assert check_capture(tmp_path / "x").ok


@pytest.mark.parametrize("hands", ["left", "both"])
def test_one_frame_has_poses_and_a_camera(make_capture: CaptureMaker, hands: str) -> None:
    capture = make_capture("a", hands=hands, frames=12, size=32, truth=True)
    poses, camera = capture.hand_poses(7), capture.camera(7)
    assert list(poses) == list(capture.info.sides)
    for side, pose in poses.items():
        given = capture.hands[side]
        assert pose.side == side
        np.testing.assert_array_equal(pose.pose, given.pose[7])
        np.testing.assert_array_equal(pose.betas, given.betas)
        np.testing.assert_array_equal(pose.transl, given.transl[7])
    np.testing.assert_array_equal(camera.K, capture.cameras.Ks[7])
    np.testing.assert_array_equal(camera.viewmat, capture.cameras.viewmats[7])
    assert (camera.width, camera.height) == (32, 32)
    for read in (capture.hand_poses, capture.camera, capture.frame):
        for frame in (-1, 12):
            with pytest.raises(UsageError, match=f"there is no frame {frame}, only 0 to 11"):
                read(frame)


def test_a_capture_describes_itself_in_a_line(make_capture: CaptureMaker) -> None:
    assert repr(make_capture("a", hands="both", frames=12, size=32, truth=True)) == (
        "<Capture 'a': 12 frames of 32 x 32 px, both hands (anny-1), motion_blur, "
        "clean frames known>"
    )


def test_equal_content_has_equal_digest_and_a_changed_pixel_another(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    first = make_capture(folder=tmp_path / "a")
    second = make_capture(folder=tmp_path / "b")
    assert first.digest == second.digest
    from hwp_bench.base.images import write_image

    picture = second.frame(3)
    picture[0, 0, 0] ^= 1
    write_image(second.root / "frames" / "000003.png", picture)
    report = check_capture(second.root)
    assert not report.ok
    assert [finding.field for finding in report.findings] == ["digests.frames"]


def test_an_interrupted_writer_leaves_nothing(make_capture: CaptureMaker, tmp_path: Path) -> None:
    info = make_capture(frames=10).info
    target = tmp_path / "half"
    with (
        pytest.raises(RuntimeError),
        CaptureWriter(target, info, {"right": hand_parameters(10)}, cameras(10, 32)) as writer,
    ):
        writer.frame(0, hand_picture(0, 32)[0])
        raise RuntimeError
    with (
        pytest.raises(BadCapture, match=r"10 of 10 images were not given \(first: 0\)"),
        CaptureWriter(target, info, {"right": hand_parameters(10)}, cameras(10, 32)) as writer,
    ):
        for frame in range(10):
            writer.frame(frame, hand_picture(frame, 32)[0])
    assert not target.exists()
    assert {item.name for item in tmp_path.iterdir()} == {"tiny"}


def test_the_writer_refuses_what_contradicts(make_capture: CaptureMaker, tmp_path: Path) -> None:
    info = make_capture(frames=10).info
    hands, track = {"right": hand_parameters(10)}, cameras(10, 32)
    with pytest.raises(BadCapture, match="parameters of"):
        CaptureWriter(tmp_path / "x", info, {"left": hands["right"]}, track)
    with pytest.raises(BadCapture, match="9 poses for 10 frames"):
        CaptureWriter(tmp_path / "x", info, {"right": hand_parameters(9)}, track)
    with pytest.raises(BadCapture, match="9 cameras"):
        CaptureWriter(tmp_path / "x", info, hands, cameras(9, 32))
    with pytest.raises(BadCapture, match="not a capture id"):
        CaptureWriter(tmp_path / "x", replace(info, id="../up"), hands, track)
    with (
        pytest.raises(UsageError, match="exists"),
        CaptureWriter(tmp_path / "tiny", info, hands, track),
    ):
        pass
    with (
        pytest.raises(ShapeMismatch, match=r"frames\[3\]"),
        CaptureWriter(tmp_path / "x", info, hands, track) as writer,
    ):
        writer.frame(3, np.zeros((31, 32, 3), np.uint8))
    with (
        pytest.raises(BadInput, match="leads out"),
        CaptureWriter(tmp_path / "x", info, hands, track) as writer,
    ):
        writer.extra("../../file", b"")


def _edit(root: Path, **changes: object) -> None:
    path = root / "capture.json"
    value = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in value.items() if v != "DELETE"}))


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"schema": "hwp-capture/9"}, "schema: is 'hwp-capture/9'"),
        ({"fps": "DELETE"}, "fps: is missing"),
        ({"fps": -1}, "fps: is -1, expected a finite number from 0.001 to 1e+06"),
        ({"fps": 0}, "fps: is 0, expected a finite number from 0.001"),
        ({"fps": 1e-300}, "fps: is 1e-300, expected a finite number from 0.001"),
        ({"fps": 1e7}, "fps: is 10000000.0, expected a finite number from 0.001"),
        ({"width": 1.5}, "width: is 1.5, expected an integer from 1 to 8192"),
        ({"frame_count": True}, "frame_count"),
        ({"frame_count": 10**9}, "frame_count"),
        ({"hands": "three"}, "hands: is 'three', expected one of right, left, both"),
        ({"id": "a/b"}, "not a capture id"),
        ({"perturbations": {"fog": None}}, "no perturbation 'fog'"),
        ({"perturbations": {"motion_blur": [0]}}, "list of 12 severities"),
        ({"perturbations": {"motion_blur": [9] * 12}}, "severity 9 of frame 0"),
        ({"hand_model": {"name": "anny-1"}}, "hand_model.digest: is missing"),
        ({"source": []}, "source"),
        ({"times": [0.0, 0.1]}, "times: must be null or 12 rising seconds, the first 0"),
        ({"times": [0.1 * (f if f != 5 else 4) for f in range(12)]}, "times: must be null or 12"),
        ({"times": [0.1 * (f + 1) for f in range(12)]}, "times: must be null or 12"),
        ({"times": ["0"] * 12}, "times[0]"),
    ],
)
def test_damaged_metadata_is_named(
    make_capture: CaptureMaker, changes: dict[str, object], problem: str
) -> None:
    root = make_capture(frames=12).root
    _edit(root, **changes)
    with pytest.raises(HwpError) as caught:
        open_capture(root)
    assert problem in str(caught.value)
    assert not check_capture(root).ok


def test_times_are_optional_and_come_back(make_capture: CaptureMaker, tmp_path: Path) -> None:
    """Of an even rate nothing is written, so that digests are those of versions without times."""
    capture = make_capture(frames=4)
    assert "times" not in json.loads((capture.root / "capture.json").read_text())
    np.testing.assert_allclose(capture.info.frame_times(), np.arange(4) / 30)
    times = (0.0, 0.033, 0.1, 0.135)
    _edit(capture.root, times=times)
    again = open_capture(capture.root)
    assert again.info.times == times
    np.testing.assert_array_equal(again.info.frame_times(), times)
    assert again.info.to_json()["times"] == times
    assert check_capture(capture.root).ok


@pytest.mark.parametrize(
    ("maker", "made_by"),
    [
        ({"name": "video", "version": 2}, "video 2"),
        ({"name": "video"}, None),
        ({"name": ["video"], "version": {}}, None),
        ("video 2", None),
        (None, None),
    ],
)
def test_the_importer_s_version_is_read_where_it_is_said(
    make_capture: CaptureMaker, maker: object, made_by: str | None
) -> None:
    root = make_capture(frames=3).root
    assert open_capture(root).info.made_by is None
    _edit(root, source={"importer": maker})
    assert open_capture(root).info.made_by == made_by


def _arrays(root: Path, file: str, **changes: np.ndarray) -> None:
    with np.load(root / file) as archive:
        arrays = {**archive, **changes}
    np.savez(root / file, **arrays)


def test_damaged_numbers_are_named(make_capture: CaptureMaker, tmp_path: Path) -> None:
    bad = hand_parameters(12).pose
    bad[5, 3, 1] = np.nan
    root = make_capture("a", frames=12).root
    _arrays(root, "hands.npz", right_pose=bad)
    with pytest.raises(BadInput, match=r"right_pose: holds NaN or infinity \(first in row 5\)"):
        open_capture(root)
    _arrays(root, "hands.npz", right_pose=bad[:11])
    with pytest.raises(BadInput, match=r"has shape \(11, 16, 3\) where \(12, 16, 3\)"):
        open_capture(root)
    (root / "hands.npz").write_bytes(b"no zip")
    with pytest.raises(BadInput, match="not a readable array file"):
        open_capture(root)
    root = make_capture("b", frames=12).root
    Ks = cameras(12, 32).Ks.copy()
    Ks[4, 1, 1] = 0
    _arrays(root, "cameras.npz", Ks=Ks)
    with pytest.raises(BadInput, match="Ks: frame 4 has a focal length that is not above 0"):
        open_capture(root)
    viewmats = cameras(12, 32).viewmats.copy()
    viewmats[2, 0, 0] = 2
    with pytest.raises(BadInput, match="frame 2 has a rotation that is not orthonormal"):
        Cameras(cameras(12, 32).Ks, viewmats)


def test_the_check_names_damaged_files_and_strangers(make_capture: CaptureMaker) -> None:
    root = make_capture(frames=12, truth=True).root
    (root / "truth" / "hands.npz").write_bytes(b"x")
    (root / "frames" / "000004.png").write_bytes(b"")
    (root / "masks" / "000002.png").unlink()
    (root / "frames" / "notes.txt").write_text("x")
    report = check_capture(root)
    assert not report.ok
    problems = {Path(f.where).name: f.problem for f in report.findings}
    assert problems["000004.png"] == "is empty (0 bytes)"
    assert problems["000002.png"] == "does not exist"
    assert problems["frames"] == "holds 1 further files: notes.txt"
    assert problems["hands.npz"].startswith("is not ")


def test_a_hand_behind_the_camera_and_an_empty_mask_are_found(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    info = make_capture(frames=10).info
    hands = hand_parameters(10)
    hands.transl[6, 2] = -0.5
    with CaptureWriter(tmp_path / "x", info, {"right": hands}, cameras(10, 32)) as writer:
        for frame in range(10):
            picture, mask = hand_picture(frame, 32)
            writer.frame(frame, picture)
            writer.mask(frame, mask * (frame != 3))
    findings = check_capture(tmp_path / "x").findings
    assert [(f.level, f.field) for f in findings] == [("error", "right_transl"), ("warning", None)]
    assert "the hand lies behind the camera in 1 of 10 frames: 6" in findings[0].problem
    assert "covers 0.00 %" in findings[1].problem


def test_a_damaged_hand_template_is_reported(
    make_capture: CaptureMaker, free_right: HandTemplate, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = make_capture("a", frames=12)
    assert mesh_problems(free_right) == []
    assert mesh_problems(mirror_template(free_right)) == []
    faces = free_right.faces.copy()
    faces[0] = faces[0, ::-1]
    turned = replace(free_right, faces=faces)
    assert mesh_problems(turned) == ["has faces that turn in different directions"]
    inside_out = replace(free_right, faces=free_right.faces[:, ::-1].copy())
    assert mesh_problems(inside_out) == ["is turned inside out"]
    middle = len(faces) // 2
    holed = replace(free_right, faces=np.delete(free_right.faces, middle, axis=0))
    assert mesh_problems(holed) == ["has 2 openings where only the wrist is open"]
    vertices = free_right.vertices.copy()
    vertices[faces[middle]] = vertices[faces[middle, 0]]
    assert "without an area" in mesh_problems(replace(free_right, vertices=vertices))[0]
    monkeypatch.setattr("hwp_bench.capture.folder.Capture.template", lambda *_: turned)
    report = check_capture(capture.root)
    assert report.ok
    assert [finding.problem for finding in report.findings] == [
        "the right template has faces that turn in different directions"
    ]


SIZE, FRAMES = 64, (20, 80)
PIXELS = SIZE * SIZE * 4


def read_and_score(capture: Capture) -> None:
    for frame in range(len(capture)):
        image = capture.frame(frame)
        with contextlib.suppress(EmptyMask):
            score_frame(image, image, capture.mask(frame))


def peak(work: Callable[[], object]) -> int:
    """Largest memory of Python and NumPy during the work, bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def grown(works: dict[int, Callable[[], object]]) -> float:
    """Bytes that each further frame takes."""
    works[FRAMES[0]]()  # what is loaded once is loaded now
    few, many = (peak(works[count]) for count in FRAMES)
    return (many - few) / (FRAMES[1] - FRAMES[0])


@pytest.fixture
def paths(make_capture: CaptureMaker) -> dict[int, Path]:
    made = {n: make_capture(f"long{n}", frames=n, size=SIZE) for n in FRAMES}
    return {count: capture.root for count, capture in made.items()}


def test_reading_checking_and_scoring_keep_no_frame(paths: dict[int, Path]) -> None:
    checks = {count: partial(check_capture, path) for count, path in paths.items()}
    scores = {count: partial(read_and_score, open_capture(path)) for count, path in paths.items()}
    assert grown(checks) < PIXELS / 4
    assert grown(scores) < PIXELS / 4


def test_writing_keeps_no_frame(make_capture: CaptureMaker, tmp_path: Path) -> None:
    calls = iter(range(10))

    def write(frames: int) -> None:
        make_capture(f"w{frames}", frames=frames, size=SIZE, folder=tmp_path / str(next(calls)))

    assert grown({count: partial(write, count) for count in FRAMES}) < PIXELS / 4


@pytest.fixture
def path(tmp_path: Path) -> Path:
    templates = {side: load_template("anny", side) for side in ("right", "left")}
    grown = {
        side: rebuilt(template, vertices=1.1 * template.vertices, joints=1.2 * template.joints)
        for side, template in templates.items()
    }
    write_subject_mesh(tmp_path / "template.npz", grown)
    return tmp_path / "template.npz"


@pytest.mark.parametrize("side", ["right", "left"])
def test_it_is_read_as_it_was_written(path: Path, side: str) -> None:
    model = load_template("anny", side)
    own = read_subject_mesh(path, model)
    assert own.vertices == pytest.approx(1.1 * model.vertices, abs=1e-6)
    assert own.joints == pytest.approx(1.2 * model.joints, abs=1e-6)
    assert own.weights == pytest.approx(model.weights, abs=1e-6)
    assert (own.side, own.name) == (side, model.name)
    assert own.digest != model.digest
    assert not own.shape_basis.any()
    assert not own.joint_basis.any()


@pytest.mark.parametrize(
    ("field", "spoilt", "reason"),
    [
        ("vertices", lambda array: array[:-1], "has shape"),
        ("vertices", lambda array: array * np.nan, "NaN"),
        ("vertices", lambda array: array + 5.0, "1 m away"),
        ("joints", lambda array: array - 5.0, "1 m away"),
        ("weights", lambda array: 2.0 * array, "sum to 1"),
        ("weights", lambda array: np.array([b"text"]), "has shape"),
    ],
)
def test_a_damaged_file_is_refused(path: Path, field: str, spoilt, reason: str) -> None:
    arrays = read_npz(path)
    write_npz(path, arrays | {f"right_{field}": spoilt(arrays[f"right_{field}"])})
    with pytest.raises(BadInput, match=reason):
        read_subject_mesh(path, load_template("anny", "right"))


@pytest.mark.parametrize(
    ("declared", "said"),
    [({}, "unknown"), ({"motion_blur": None}, "motion_blur unknown"), (None, "motion_blur 5")],
)
def test_frames_of_unknown_perturbations_are_unknown(
    declared, said: str, make_capture: CaptureMaker, capsys
) -> None:
    capture = make_capture(perturbations=declared)
    assert main(["data", "check", str(capture.root)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "perturbed_frames" in line)
    assert row.split(maxsplit=1)[1].strip() == said
    value = check_capture(capture.root).facts["perturbed_frames"]
    assert value == {"unknown": None, "motion_blur unknown": {"motion_blur": None}}.get(
        said, {"motion_blur": 5}
    )


def test_a_simulated_capture_without_effects_has_none(make_capture: CaptureMaker) -> None:
    from hwp_bench.capture.check import _perturbed_frames

    info = make_capture(perturbations={}).info
    assert _perturbed_frames(replace(info, source={"kind": "simulated"})) == {}


def test_the_contact_sheet_draws_each_frame_with_its_own_mask_and_hands(
    make_painted: Callable[..., Capture],
) -> None:
    """Oracle: landmarks projected by the pinhole formula here."""
    capture = make_painted("both")
    edge = capture.info.width
    page = contact_sheet(capture, count=6, edge=edge)
    for place, frame in enumerate(evenly(len(capture), 6).tolist()):
        seen = {}
        for side in capture.info.sides:
            posed = pose_parameters(capture.template(side), capture.hands[side])
            points, view = posed.landmarks[frame].numpy(), capture.cameras.viewmats[frame]
            rays = (points @ view[:3, :3].T + view[:3, 3]) @ capture.cameras.Ks[frame].T
            seen[side] = rays[:, :2] / rays[:, 2:]
        expected = draw_hands(outlined(capture.frame(frame), capture.mask(frame)), seen)
        left = GAP + place * (edge + GAP)
        tile = page[GAP + LABEL_HEIGHT :][:edge, left : left + edge]
        assert (tile != expected).any(axis=2).mean() < 0.01
    # Hands of another edition of the model would be drawn elsewhere.
    model = replace(capture.info.hand_model, digest="0" * 64)
    other = replace(capture, info=replace(capture.info, hand_model=model))
    with pytest.raises(BadInput, match="belongs to another edition of hand model"):
        contact_sheet(other, count=6, edge=edge)
