"""The official release. Oracles: the fixture's posing (the tracker's own convention, by another
route than the importer's), OpenCV's affine warp, and the released loader's arithmetic by hand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from official_release import (
    FOCAL,
    HEIGHT,
    WIDTH,
    official_rows,
    project,
    write_pickles,
    write_release,
)
from synthetic_mano import write_mirrored_mano

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.splits import contiguous_split, split_for
from hwp_bench.cli.main import main
from hwp_bench.hands import HandTemplate, load_template, pose_hand
from hwp_bench.importers.official import OfficialImport, import_official
from hwp_bench.importers.official.from_release import (
    box_of_landmarks,
    correct_crop,
    crop_frames,
    official_crop,
)
from hwp_bench.importers.official.records import find_folders, read_records
from hwp_bench.importers.shared.output import project_hand

FRAMES = 12


@pytest.fixture(scope="module")
def mano(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mirrored_mano(tmp_path_factory.mktemp("mano"))


@pytest.fixture(scope="module")
def right(mano: Path) -> HandTemplate:
    return load_template(f"mano:{mano}")


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory, right: HandTemplate) -> Path:
    root = tmp_path_factory.mktemp("release") / "WildGHand"
    write_release(root / "capture4_subsample4", right, FRAMES, pickles=2)
    write_release(root / "capture0_subsample3_single", right, FRAMES, sides=("left",))
    return root


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, release: Path, mano: Path) -> Path:
    out = tmp_path_factory.mktemp("captures")
    for folder in find_folders(release):
        import_official(folder, out / folder.id, OfficialImport(mano=mano))
    return out


def posed_vertices(capture: Capture, side: str) -> np.ndarray:
    hand = capture.hands[side]
    template = load_template(capture.info.hand_model.source, side)
    posed = pose_hand(
        template.to_torch(torch.float64),
        *map(torch.from_numpy, (hand.pose, hand.betas, hand.transl)),
    )
    return posed.vertices.numpy()


def test_captures_say_where_they_come_from(captures: Path) -> None:
    two, one = open_capture(captures / "capture4"), open_capture(captures / "capture0")
    for capture in (two, one):
        assert check_capture(capture.root).ok
        assert capture.info.source["frames"] == list(range(FRAMES))
        assert read_rgb(capture.root / "extra" / "overlay.png").shape[2] == 3
    assert (two.info.hands, two.info.fps, two.info.action) == ("both", 7.5, "Spinning a pen")
    assert two.info.source["subsample"] == 4
    assert two.info.perturbations == {"hand_object_interaction": None, "motion_blur": None}
    assert (one.info.hands, one.info.fps, one.info.source["subsample"]) == ("left", 10.0, 3)
    told = json.loads((one.root / "extra" / "import.json").read_text())["warnings"]
    assert len(told) == 1
    assert "left hand taken" in told[0]


def test_the_split_has_a_validation_part_of_its_own(captures: Path) -> None:
    # The released loader's validation reads its test frames; ours must not.
    capture = open_capture(captures / "capture4")
    split = split_for(capture.info.id, len(capture))
    assert split == contiguous_split("capture4", FRAMES)
    assert (split.train_range, split.validation_range, split.test_range) == (
        (0, 9),
        (9, 10),
        (10, 12),
    )


@pytest.mark.parametrize(
    ("name", "side"), [("capture4", "right"), ("capture4", "left"), ("capture0", "left")]
)
def test_hands_are_where_the_tracker_has_them(
    captures: Path, release: Path, name: str, side: str
) -> None:
    capture = open_capture(captures / name)
    folder = next(f for f in find_folders(release) if f.id == name)
    records = read_records(folder)
    # One shape for all frames instead of one each (0.02 standard deviations apart in the
    # fixture, of 2 mm each) moves single vertices by less than 1.5 mm.
    gap = np.linalg.norm(posed_vertices(capture, side) - records.sides[side].vertices, axis=-1)
    assert gap.mean() < 0.4e-3
    assert gap.max() < 1.5e-3
    # In the crop: by the capture's own camera, against the whole frame's pixels through the crop.
    clip = project_hand(
        load_template(capture.info.hand_model.source, side), capture.hands[side], capture.cameras
    )
    for frame in range(FRAMES):
        K = capture.cameras.Ks[frame]
        scale = K[0, 0] / FOCAL
        pixels = project(records.sides[side].vertices[frame]) - [WIDTH / 2, HEIGHT / 2]
        assert np.abs(clip.pixels[frame] - (pixels * scale + K[:2, 2])).max() < 1.0


def test_pictures_and_masks_lie_under_the_hands(captures: Path) -> None:
    capture = open_capture(captures / "capture4")
    drawn = np.zeros(capture.size, dtype=bool)
    for side in ("right", "left"):
        template = load_template(capture.info.hand_model.source, side)
        clip = project_hand(template, capture.hands[side], capture.cameras)
        from hwp_bench.hands.raster import draw_silhouette

        drawn |= draw_silhouette(clip.pixels[6], clip.faces, 256) > 0
    mask = capture.mask(6) > 127
    assert (drawn & mask).sum() / (drawn | mask).sum() > 0.97
    assert capture.frame(6)[mask].mean() > 130
    assert capture.frame(6)[~mask].mean() < 60


@settings(max_examples=40, deadline=None)
@given(st.integers(-40, 200), st.integers(-40, 150), st.integers(30, 260), st.integers(20, 200))
@example(-16, 0, 40, 20)
def test_a_correct_crop_shows_a_point_where_its_camera_says(x: int, y: int, w: int, h: int) -> None:
    # A bright dot of 9 px; its centroid in the crop against the projection, within 0.6 px.
    centre = np.array([x + w / 2, y + h / 2]).clip([20, 20], [WIDTH - 20, HEIGHT - 20])
    picture = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    column, row = centre.astype(int)
    picture[row - 4 : row + 5, column - 4 : column + 5] = 250
    box = np.array([x, y, x + w, y + h])
    crop = correct_crop(picture, picture[:, :, 0], box, FOCAL, 256)
    assert crop.K[0, 0] == crop.K[1, 1] == pytest.approx(FOCAL * 256 / crop.side)
    point = (np.array([column + 0.5, row + 0.5]) - [WIDTH / 2, HEIGHT / 2]) / FOCAL
    expected = crop.K[:2, :2] @ point + crop.K[:2, 2]
    weight = crop.image[:, :, 0].astype(float)
    # The whole dot has to lie in the crop: a cut dot has another centroid.
    reach = 6 * 256 / crop.side
    if not (expected.min() > reach and expected.max() < 256 - reach) or crop.side < 40:
        return
    rows, columns = np.mgrid[:256, :256] + 0.5
    found = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    assert np.abs(found - expected).max() < 0.6


def test_the_loaders_crop_and_its_focal_length_that_shifts() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    mask = np.where(rng.random((HEIGHT, WIDTH)) < 0.5, 101, 100).astype(np.uint8)
    box = np.array([37, 20, 190, 101])  # 153 x 81: the squared corner is 113.5 - 76.5, 60.5 - 76.5
    crop = official_crop(picture, mask, box, FOCAL, 256)
    # By hand: edge 153, centre (113.5, 60.5), corner (37, -16), scale 256 / 153.
    scale = 256 / 153
    assert crop.side == 153
    np.testing.assert_array_equal(crop.corner, [37, -16])
    np.testing.assert_allclose(
        np.diag(crop.K), [scale * FOCAL - scale * 37, scale * FOCAL + scale * 16, 1], rtol=1e-12
    )
    np.testing.assert_allclose(crop.K[:2, 2], [scale * (200 - 37), scale * (150 + 16)], rtol=1e-12)
    corners = np.float32([[37, -16], [190, -16], [37, 137]])
    warp = cv2.getAffineTransform(corners, np.float32([[0, 0], [256, 0], [0, 256]]))
    expected = cv2.warpAffine(picture.astype(np.float32), warp, (256, 256), flags=cv2.INTER_LINEAR)
    hand = cv2.warpAffine((mask > 100).astype(np.uint8), warp, (256, 256), flags=cv2.INTER_LINEAR)
    np.testing.assert_array_equal(crop.mask > 0, hand > 0)
    difference = np.abs(crop.image.astype(float) - expected * (hand > 0)[:, :, None])
    assert difference.max() <= 1.0
    # The correct camera differs from it by the shift alone.
    right_crop = correct_crop(picture, mask, box, FOCAL, 256)
    np.testing.assert_allclose(right_crop.K[0, 0] - crop.K[0, 0], scale * 37, rtol=1e-9)
    np.testing.assert_allclose(right_crop.K[1, 1] - crop.K[1, 1], -scale * 16, rtol=1e-9)


def test_whole_numbers_cut_the_loaders_corner_off() -> None:
    picture = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    whole = official_crop(picture, picture[:, :, 0], np.array([10, 11, 30, 26]), FOCAL, 256)
    exact = official_crop(picture, picture[:, :, 0], np.array([10.0, 11, 30, 26]), FOCAL, 256)
    np.testing.assert_array_equal(whole.corner, [10, 8])
    np.testing.assert_array_equal(exact.corner, [10, 8.5])


def test_compat_swaps_the_translations(
    release: Path, captures: Path, mano: Path, tmp_path: Path
) -> None:
    folder = next(f for f in find_folders(release) if f.id == "capture4")
    import_official(folder, tmp_path / "c", OfficialImport(mano=mano, official_compat=True))
    compat, plain = open_capture(tmp_path / "c"), open_capture(captures / "capture4")
    # The fixture's left hand has (4, 0, 50) mm more translation than the right one.
    for side, sign in (("right", 1.0), ("left", -1.0)):
        moved = compat.hands[side].transl - plain.hands[side].transl
        np.testing.assert_allclose(
            moved, sign * np.tile([0.004, 0.0, 0.05], (FRAMES, 1)), atol=1e-9
        )
        np.testing.assert_array_equal(compat.hands[side].pose, plain.hands[side].pose)
    assert compat.cameras.Ks[0, 0, 0] != compat.cameras.Ks[0, 1, 1]
    assert not compat.frame(0)[compat.mask(0) == 0].any()
    assert compat.info.source["import"]["official_compat"]


def test_a_left_hand_without_its_place_is_not_valid(tmp_path: Path, right: HandTemplate) -> None:
    def change(rows: list) -> list:
        rows[1]["root_rel"] = np.full((1, 3), np.nan)
        return rows

    folder = find_folders(records_with(tmp_path, right, change))[0]
    import_official(folder, tmp_path / "c", OfficialImport())
    hands = open_capture(tmp_path / "c").hands
    assert hands["left"].valid.tolist() == [True, False, True]
    assert hands["right"].valid.all()


def test_compat_needs_the_translation_of_the_hand_that_is_not_shown(
    tmp_path: Path, right: HandTemplate, mano: Path
) -> None:
    place = tmp_path / "capture0_subsample3_single"
    rows = write_release(place, right, 3, sides=("right",))
    [folder], choices = find_folders(place), OfficialImport(mano=mano, official_compat=True)
    import_official(folder, tmp_path / "a", choices)
    import_official(folder, tmp_path / "b", OfficialImport(mano=mano))
    moved, own = (open_capture(tmp_path / name).hands["right"].transl for name in "ab")
    np.testing.assert_allclose(moved - own, np.tile([0.004, 0.0, 0.05], (3, 1)), atol=1e-9)
    for row in rows:
        row["cam_aligned_left"] = np.full((1, 3), np.nan)
    write_pickles(place, rows)
    with pytest.raises(BadInput, match="cam_aligned_left: no frame has a finite right and left"):
        import_official(folder, tmp_path / "c", choices)


def test_without_mano_the_free_hand_is_fitted(release: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "free"
    words = ["data", "import", "wildghand", str(release / "capture4_subsample4"), "-o", str(out)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "mm from the tracker's vertices" in printed
    capture = open_capture(out)
    assert check_capture(out).ok
    assert capture.info.hand_model.name == "anny-1"
    # The synthetic MANO is a blob with other proportions than a hand.
    facts = capture.info.source["import"]
    assert max(facts["vertex_error_mm"].values()) < 8.0
    assert min(facts["vertices_on_mask"].values()) > 0.9
    assert main([*words, "--size", "128"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_folder_of_captures_is_continued(
    release: Path, mano: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As after a kill between its captures. What cannot be written is refused before any work."""
    out = tmp_path / "captures"
    words = ["data", "import", "wildghand", str(release), "-o", str(out), "--mano", str(mano)]
    assert main([*words, "--json"]) == 0
    facts = capsys.readouterr().out
    shutil.rmtree(out / "capture4")
    before = (out / "capture0" / "capture.json").stat().st_mtime_ns
    assert main([*words, "--json"]) == 0
    told = capsys.readouterr()
    assert f"{out / 'capture0'} is complete: the same call has made it" in told.err
    assert (out / "capture0" / "capture.json").stat().st_mtime_ns == before
    assert told.out == facts
    # What another call has made, or an import without a digest, is not taken for it.
    shutil.rmtree(out / "capture0")
    assert main([*words, "--size", "128"]) == 2
    (out / "capture4" / "extra" / "import.json").write_text("{}")
    assert main(words) == 2
    assert capsys.readouterr().err.count("capture4: exists already") == 2
    assert not (out / "capture0").exists()


def test_a_side_of_two_hands_is_refused(release: Path, tmp_path: Path) -> None:
    folder = next(f for f in find_folders(release) if f.id == "capture4")
    with pytest.raises(UsageError, match="--side: capture4 shows two hands, and both are"):
        import_official(folder, tmp_path / "c", OfficialImport(hand="right"))


def test_a_hand_in_frames_of_one_colour_only_is_refused(
    tmp_path: Path, right: HandTemplate, mano: Path
) -> None:
    folder = tmp_path / "capture4_subsample4"
    write_release(folder, right, 3)
    for image in folder.glob("0000?.png"):
        cv2.imwrite(str(image), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(BadInput, match="the right hand is in frames of one colour only") as caught:
        import_official(find_folders(folder)[0], tmp_path / "c", OfficialImport(mano=mano))
    assert caught.value.where == str(folder)


def records_with(tmp_path: Path, right: HandTemplate, change: Any) -> Path:
    folder = tmp_path / "capture4_subsample4"
    rows = write_release(folder, right, 3)
    changed = change(rows)
    write_pickles(folder, rows if changed is None else changed)
    return folder


def read(folder: Path) -> Any:
    return read_records(find_folders(folder)[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[1].pop("mano_pose_left"), "mano_pose_left: frame 1: is missing"),
        (lambda rows: rows[1].update(cam_aligned_right=np.zeros((3, 1))), "cam_aligned_right"),
        (lambda rows: rows[1].update(mano_shape_right="x"), "is a str, not an array"),
        (lambda rows: rows[1].update(mano_shape_right=np.array([["a"] * 10])), "holds <U1"),
        (lambda rows: rows[1].update(scaled_focal_length=-2.0), "not a focal length"),
        (lambda rows: rows[1].update(scaled_focal_length=float("nan")), "not a focal length"),
        (lambda rows: rows[1].update(bbox_inter=np.array([9, 9, 3, 20])), "is not a box"),
        (lambda rows: rows[1].update(img_path="no number.png"), "has no number"),
        (
            lambda rows: rows[1].update(img_path=rows[0]["img_path"]),
            "two records have the number 0",
        ),
        (lambda rows: rows[1].update(img_path=7), "is a int, not a string"),
        (lambda rows: rows[1].update(mask_sam1_path="/etc/hostname1"), "which is not in"),
        (lambda rows: rows[1].pop("root_rel"), "root_rel: frame 1: is missing"),
        (lambda rows: {"frames": rows}, "not a list"),
        (lambda rows: [1, 2], "record 0 is not a dict"),
        (lambda rows: [], "not a list"),
    ],
)
def test_records_that_break_the_format_are_named(
    tmp_path: Path, right: HandTemplate, change: Any, message: str
) -> None:
    def changed(rows: list) -> Any:
        result = change(rows)
        return (
            result
            if isinstance(result, list) or (isinstance(result, dict) and "frames" in result)
            else None
        )

    with pytest.raises(BadInput, match=message):
        read(records_with(tmp_path, right, changed))


def test_odd_but_honest_records_are_read_and_told(
    tmp_path: Path, right: HandTemplate, mano: Path
) -> None:
    def change(rows: list) -> list:
        rows[2]["tracker_version"] = "2"
        rows[0].pop("mask_sam1_path")
        rows[0].pop("bbox_inter")
        rows[1]["mano_pose_left"] = np.full((1, 48), np.nan)
        rows[1]["img_path"] = "C:\\data\\" + rows[1]["img_path"].rsplit("/", 1)[1]
        return rows[::-1]

    folder = records_with(tmp_path, right, change)
    facts = import_official(find_folders(folder)[0], tmp_path / "c", OfficialImport(mano=mano))
    capture = open_capture(tmp_path / "c")
    np.testing.assert_array_equal(capture.hands["left"].valid, [True, False, True])
    assert capture.info.source["frames"] == [0, 1, 2]
    told = " | ".join(facts["warnings"])
    assert "unknown key 'tracker_version'" in told
    assert "order" in told
    with pytest.raises(BadInput, match="no bbox_inter"):
        import_official(
            find_folders(folder)[0], tmp_path / "d", OfficialImport(mano=mano, official_compat=True)
        )
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("compat", [False, True])
def test_a_box_that_no_hand_can_have_is_refused(
    tmp_path: Path, right: HandTemplate, compat: bool
) -> None:
    """Oracle: three times the 400 px of the image, which a crop may have."""
    rows = write_release(tmp_path / "capture4_subsample4", right, 3)

    def crop() -> Any:
        return crop_frames(read(tmp_path / "capture4_subsample4"), 64, compat=compat)[0][1]

    def spoil(key: str, value: np.ndarray) -> None:
        rows[1][key] = value
        write_pickles(tmp_path / "capture4_subsample4", rows)

    spoil("bbox_inter", np.array([-400, 0, 800, 300]))
    assert crop().side == 1200
    for edge in (1201, 1_000_000):
        spoil("bbox_inter", np.array([-401, 0, edge - 401, 300]))
        with pytest.raises(BadInput, match=rf"bbox_inter: frame 1: .* {edge} px large"):
            crop()
    if not compat:
        rows[1].pop("bbox_inter")
        for far in (4e5, 1e300):
            joints = rows[1]["joints2d_world_left"].copy()
            joints[0, 3] = far
            spoil("joints2d_world_left", joints)
            with pytest.raises(BadInput, match=r"00001.png: joints2d_world_left: frame 1: .*large"):
                crop()


def test_the_box_of_joints_is_the_releases(right: HandTemplate) -> None:
    for row in official_rows(right, 3):
        both = np.concatenate([row["joints2d_world_right"][0], row["joints2d_world_left"][0]])
        np.testing.assert_array_equal(box_of_landmarks(both), row["bbox_inter"])


def test_folder_names(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is not a folder"):
        find_folders(tmp_path / "none")
    with pytest.raises(BadInput, match=r"no output\.pkl"):
        find_folders(tmp_path)
    for name in ("capture4_subsample4", "capture11_subsample2", "capture4_subsample2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "output.pkl").write_bytes(b"")
    folder = find_folders(tmp_path / "capture4_subsample4")[0]
    assert (folder.id, folder.subsample, folder.single) == ("capture4", 4, False)
    with pytest.raises(BadInput, match="capture11"):
        find_folders(tmp_path / "capture11_subsample2")
    assert find_folders(tmp_path / "capture11_subsample2", "mine")[0].id == "mine"
    (tmp_path / "capture11_subsample2" / "output.pkl").unlink()
    with pytest.raises(BadInput, match="capture4 twice"):
        find_folders(tmp_path)


def test_a_wrong_hand_model_is_noticed(release: Path, tmp_path: Path, mano: Path) -> None:
    from synthetic_mano import as_published, mano_content

    other = tmp_path / "other"
    other.mkdir()
    for side in ("right", "left"):
        content = mano_content(side)
        content["v_template"] = content["v_template"] * 1.4
        (other / f"MANO_{side.upper()}.pkl").write_bytes(as_published(content))
    folder = next(f for f in find_folders(release) if f.id == "capture4")
    with pytest.raises(BadInput, match="misses the stored vertices"):
        import_official(folder, tmp_path / "c", OfficialImport(mano=other))


def test_options_that_make_no_sense_are_refused() -> None:
    with pytest.raises(UsageError, match="--side: must be right or left"):
        OfficialImport(hand="both")
    for options in (
        {"size": 8},
        {"size": 128, "official_compat": True},
        {"video_fps": 0},
    ):
        with pytest.raises(UsageError):
            OfficialImport(**options)
