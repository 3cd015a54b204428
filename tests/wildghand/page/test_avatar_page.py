"""The page of an avatar. Oracles: `WildGHandAvatar.render` in the same pose and camera, the model
with its biases, cv2.projectPoints.

Tolerance: 42 dB over the hand's box, which is the mean error of 2.0 grey levels.
"""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser import least_contrast, open_page, overflow, show
from scipy.spatial.transform import Rotation
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import anatomical_limits, load_template, pose_from_joint_angles
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.methods.contract import HandPose
from wildghand.avatar import WildGHandAvatar, load_avatar, save_avatar
from wildghand.cli.main import main
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import StepBatch
from wildghand.model.settings import read_settings
from wildghand.page import write_page
from wildghand.page.bake import pack_correctives
from wildghand.page.write import PageSettings, best_start, mean_weights, sample_poses
from wildghand.splat import rasterize
from wildghand.visibility import ColorChanges

QUICK: dict[str, Any] = {**TINY, "gaussians": 600}
SMALL = PageSettings(still_size=48)
# Nothing turns by itself.
STILL = ("--force-prefers-reduced-motion",)
LEAST = 42.0


def psnr(found: np.ndarray, truth: np.ndarray, coverage: np.ndarray) -> float:
    """Over the box of what is covered, dB."""
    seen = np.argwhere(coverage > 0.5)
    box = tuple(slice(a, b + 1) for a, b in zip(seen.min(0), seen.max(0), strict=True))
    return -10.0 * np.log10(np.square(found[box] - truth[box]).mean() + 1e-12)


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    """An avatar whose biases and gains are large, as those of a dark frame would be.

    It corrects poses and changes colours by as much as a long fit does, and skin that no frame
    shows keeps its offsets.
    """
    capture = make_painted()
    avatar = wildghand.fit(capture.root, settings=QUICK, steps=60, all_frames=True)
    model, random = avatar.model, torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.biases_of("right").psi.bias.fill_(1.0)
        gains = model.log_gains
        gains.copy_(torch.linspace(-0.5, 0.2, gains.numel()).reshape(gains.shape))
        model.network.refinement_head.frame[-1].weight.normal_(0.0, 0.2, generator=random)
        count = len(model.rigs["right"])
        model.keep(ColorChanges({"right": 0.3 * torch.randn(count, 3, generator=random)}))
        found = model.visibility
        kept = found.offsets["right"].masked_fill(found.shapes["right"] <= 0.0, 1.0)
        model.keep(dataclasses.replace(found, offsets={"right": kept}))
    return avatar, capture


@pytest.fixture(scope="module")
def folder(fitted, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_avatar(fitted[0], tmp_path_factory.mktemp("page") / "avatar")


@pytest.fixture(scope="module")
def page(fitted, folder: Path) -> Path:
    out = folder.parent / "avatar.html"
    write_page(folder, out, capture=fitted[1], settings=SMALL)
    return out


@pytest.fixture(scope="module")
def opened(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with open_page(page, tmp_path_factory.mktemp("profile"), webgl=True, flags=STILL) as driver:
        driver.execute_script("avatar.setBackground('#000000')")
        yield driver


def drawn(driver: Any, capture: Capture, frame: int) -> np.ndarray:
    """The page's picture from the camera of a frame, (H, W, 3)."""
    camera = capture.camera(frame)
    given = camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height
    driver.execute_script("avatar.setCamera(...arguments)", *given)
    pixels = driver.execute_script("return avatar.pixels()")
    return np.array(pixels).reshape(camera.height, camera.width, 3) / 255.0


def test_the_page_draws_training_poses_as_the_avatar(opened, fitted) -> None:
    avatar, capture = fitted
    for frame in avatar.record.frames[3:12:4]:
        hand = capture.hand_poses(frame)["right"]
        given = {"right": [hand.pose.tolist(), hand.transl.tolist()]}
        opened.execute_script("avatar.setPose(arguments[0])", given)
        truth = avatar.render({"right": hand}, capture.camera(frame))
        assert psnr(drawn(opened, capture, frame), truth[..., :3], truth[..., 3]) > LEAST


@pytest.mark.parametrize("turn", [60, 180, 270])
def test_the_page_draws_a_hand_from_where_no_camera_stood(turn: int, opened, fitted) -> None:
    avatar, capture = fitted
    assert bool((avatar.model.visibility.shapes["right"] == 0.0).any())
    frame = avatar.record.frames[3]
    hand, camera = capture.hand_poses(frame)["right"], capture.camera(frame)
    centre = camera.viewmat[:3, :3] @ avatar.pose({"right": hand}).means.mean(axis=0)
    centre += camera.viewmat[:3, 3]
    around = np.eye(4)
    around[:3, :3] = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    around[:3, 3] = centre - around[:3, :3] @ centre
    moved = replace(camera, viewmat=around @ camera.viewmat)
    given = {"right": [hand.pose.tolist(), hand.transl.tolist()]}
    opened.execute_script("avatar.setPose(arguments[0])", given)
    truth = avatar.render({"right": hand}, moved)
    found = drawn(opened, SimpleNamespace(camera=lambda frame: moved), frame)
    assert psnr(found, truth[..., :3], truth[..., 3]) > LEAST


@pytest.mark.parametrize("turn", [0, 90, 180])
@pytest.mark.parametrize("pose", ["rest", "fist", "open"])
def test_the_page_draws_free_poses_as_the_avatar(pose: str, turn: int, opened, fitted) -> None:
    avatar, camera = fitted[0], fitted[0].studio.camera(176, 176)
    hand = avatar.studio.posed(pose, turn)["right"]
    given = {"right": [hand.pose.tolist(), hand.transl.tolist()]}
    opened.execute_script("avatar.setPose(arguments[0])", given)
    truth = avatar.render({"right": hand}, camera)
    found = drawn(opened, SimpleNamespace(camera=lambda frame: camera), 0)
    assert psnr(found, truth[..., :3], truth[..., 3]) > LEAST


def biased(avatar: WildGHandAvatar, capture: Capture, frame: int) -> np.ndarray:
    """(H, W, 4) of the model's Gaussians with the biases of a training frame."""
    given = avatar.posed({"right": capture.hand_poses(frame)["right"]})["right"]
    rows, camera = torch.tensor([avatar.record.frames.index(frame)]), capture.camera(frame)
    with torch.no_grad():
        viewmats = torch.as_tensor(camera.viewmat[None], dtype=torch.float32)
        made, _ = avatar.model.gaussians("right", *given, refine=True, rows=rows, viewmats=viewmats)
        image, cover, _ = rasterize(
            made.means,
            made.quats,
            made.scales,
            made.opacities,
            made.colors,
            viewmats,
            torch.as_tensor(camera.K[None], dtype=torch.float32),
            camera.width,
            camera.height,
        )
    return torch.cat([image, cover], dim=-1)[0].clamp(0.0, 1.0).numpy()


def test_the_page_draws_a_frame_with_its_biases(opened, fitted) -> None:
    avatar, capture = fitted
    frames = avatar.record.frames
    for row in (2, len(frames) - 3):
        opened.execute_script("avatar.setFrame(arguments[0])", row)
        pictures = {}
        for kind in ("clean", "biases"):
            opened.execute_script("avatar.setShown(arguments[0])", kind)
            pictures[kind] = drawn(opened, capture, frames[row])
        truth = biased(avatar, capture, frames[row])
        # The oracle has no wall in the wrist.
        assert psnr(pictures["biases"], truth[..., :3], truth[..., 3]) > 30.0
        assert psnr(pictures["clean"], truth[..., :3], truth[..., 3]) < 28.0
    opened.execute_script("avatar.setShown('clean')")


def test_the_page_draws_weights_in_their_colours(opened, fitted) -> None:
    _, capture = fitted
    opened.execute_script("avatar.setFrame(0); avatar.setShown('weights')")
    seen = opened.execute_script(
        "return ['biased', 'weighed'].map(id => document.getElementById(id).checkVisibility())"
    )
    assert seen == [False, True]
    picture = drawn(opened, capture, 0)
    opened.execute_script("avatar.setShown('clean')")
    assert np.abs(picture - drawn(opened, capture, 0)).max() > 0.2


def test_a_slider_bends_the_finger_that_the_avatar_bends(opened, fitted) -> None:
    avatar, capture = fitted
    frame = avatar.record.frames[0]
    hand = capture.hand_poses(frame)["right"]
    opened.execute_script("avatar.setFrame(0)")
    before = drawn(opened, capture, frame)
    for part, degrees in enumerate((50, 5, 0)):
        opened.execute_script(
            "const place = `[data-joint='1'][data-part='${arguments[0]}']`;"
            "const s = document.querySelector(place);"
            "s.value = arguments[1]; s.dispatchEvent(new Event('input'));",
            part,
            degrees,
        )
    after = drawn(opened, capture, frame)
    limits = anatomical_limits(load_template("anny", "right"))
    angles = torch.zeros(1, 15, 3, dtype=torch.float64)
    angles[0, 0] = torch.deg2rad(torch.tensor([50.0, 5.0, 0.0], dtype=torch.float64))
    bent = pose_from_joint_angles(angles, torch.as_tensor(limits.axes))[0, 0].numpy()
    pose = hand.pose.copy()
    pose[1] = bent
    posed = HandPose("right", pose, hand.betas, hand.transl)
    truth = avatar.render({"right": posed}, capture.camera(frame))
    assert psnr(after, truth[..., :3], truth[..., 3]) > LEAST
    assert psnr(after, before, truth[..., 3]) < LEAST


def test_the_page_reads_well(opened) -> None:
    assert opened.execute_script("return document.body.classList.contains('still')") is False
    for width in (1400, 400):
        for dark in (False, True):
            show(opened, width, dark=dark)
            assert overflow(opened) == 0
            assert least_contrast(opened) >= 4.5


def test_named_poses_and_light_change_the_picture(opened, fitted) -> None:
    _, capture = fitted
    pictures = []
    for name in ("rest", "fist", "point", "pinch", "spread"):
        opened.execute_script("avatar.setNamed(arguments[0])", name)
        pictures.append(drawn(opened, capture, 0))
    opened.execute_script("document.getElementById('relight').click()")
    pictures.append(drawn(opened, capture, 0))
    opened.execute_script("document.getElementById('relight').click()")
    assert all(np.abs(a - b).max() > 0.1 for i, a in enumerate(pictures) for b in pictures[:i])


VIOLET = """
avatar.orbit(arguments[0], 0);
const p = avatar.pixels();
let sum = 0;
for (let i = 0; i < p.length; i += 3) sum += p[i + 2] - p[i + 1];
return sum;
"""


SHARE = """
const done = arguments[arguments.length - 1], sent = [];
navigator.canShare = () => arguments[0];
navigator.share = async ({ files }) => { sent.push(files[0]); };
HTMLAnchorElement.prototype.click = function () { sent.push(this); };
document.getElementById("share").click();
(async () => {
  while (!sent.length) await new Promise((next) => setTimeout(next, 20));
  const blob = sent[0] instanceof File ? sent[0] : await (await fetch(sent[0].href)).blob();
  const image = await createImageBitmap(blob);
  done([sent[0].name || sent[0].download, image.width, image.height]);
})();
"""


def test_a_picture_is_sent_where_the_browser_can_and_else_a_file(opened) -> None:
    size = opened.execute_script(
        "const c = avatar.pixels() && document.querySelector('canvas');return [c.width, c.height]"
    )
    assert opened.execute_async_script(SHARE, True) == ["hand.png", *size]


def test_pose_correctives_are_those_of_the_hand_model(opened) -> None:
    random = np.random.default_rng(0)
    # As many components as are kept, so that nothing but the rounding to 8 bits is lost.
    left, right = random.normal(size=(60, 9)), random.normal(size=(9, 135))
    basis = torch.as_tensor(1e-3 * (left @ right).reshape(20, 3, 135))
    turns = axis_angle_to_matrix(torch.as_tensor(random.normal(0, 0.5, (16, 3))))
    feature = (turns[1:] - torch.eye(3)).reshape(-1)
    made = opened.execute_script(
        "const { basis, map } = arguments[0], hand = Object.create(Hand.prototype);"
        "hand.rest = new Float32Array(60);"
        "hand.correctives = { basis: unpack(basis, Int8Array), map: unpack(map, Float32Array) };"
        "return Array.from(hand.shaped(arguments[1]));",
        pack_correctives(basis),
        turns.reshape(16, 9).tolist(),
    )
    truth = (basis.double() @ feature).numpy().reshape(-1)
    np.testing.assert_allclose(made, truth, atol=0.02 * np.abs(truth).max())


def test_a_page_opens_on_skin_that_frames_show(fitted) -> None:
    avatar, capture = fitted
    camera = avatar.studio.camera(64, 64)
    marked = copy.deepcopy(avatar)
    # Skin that frames show is white, other skin black.
    kept = marked.model.visibility.shown("right")[:, None]
    marked.model.keep(ColorChanges({"right": (40.0 * (kept - 0.5)).clamp(-9, 9).expand(-1, 3)}))

    def white_less_black(hands) -> float:
        drawn = marked.render(hands, camera)
        return float((2.0 * drawn[..., 0] - drawn[..., 3]).sum())

    tried = [avatar.believed(capture.hand_poses(frame)) for frame in avatar.record.frames]
    found = {name: best_start(avatar, poses) for name, poses in (("rest", ()), ("clip", tried))}
    sides = [white_less_black(avatar.studio.posed("rest", turn)) for turn in range(0, 360, 45)]
    # The page judges anchors and not pixels.
    assert white_less_black(found["rest"]) > 0.9 * max(sides) > 0.0
    fingers = [hands["right"].pose[1:] for hands in tried]
    facing = [
        max(white_less_black(avatar.studio.posed(pose, turn)) for turn in range(0, 360, 45))
        for pose in fingers[::6]
    ]
    assert white_less_black(found["clip"]) > 0.9 * max(facing) > 0.0
    assert any(np.allclose(found["clip"]["right"].pose[1:], pose) for pose in fingers)


def test_skin_that_no_frame_shows_is_marked(opened) -> None:
    opened.execute_script("avatar.setFrame(0)")
    show(opened, 400)
    seen: list[list[float]] = []
    for _ in range(3):
        seen.append([opened.execute_script(VIOLET, yaw) for yaw in (0.0, np.pi)])
        opened.execute_script("document.getElementById('unseen').click()")
    opened.execute_script("document.getElementById('unseen').click()")
    before, marked, after = seen
    # The painted hand never turns its other side to the camera.
    assert marked[1] - before[1] > 3.0 * (marked[0] - before[0]) >= 0.0
    assert after == before


def test_the_page_asks_for_no_other_file(opened) -> None:
    asked = opened.execute_script(
        "return performance.getEntriesByType('resource').map(e => e.name)"
    )
    assert [name for name in asked if not name.startswith("data:")] == []


def test_a_network_that_is_too_large_is_drawn_by_components(
    fitted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = fitted
    monkeypatch.setattr("wildghand.page.write.network_content", lambda avatar: None)
    write_page(avatar, tmp_path / "avatar.html", capture=capture, settings=SMALL)
    frame = avatar.record.frames[5]
    with open_page(tmp_path / "avatar.html", tmp_path, webgl=True, flags=STILL) as driver:
        driver.execute_script("avatar.setBackground('#000000'); avatar.setFrame(5)")
        found = drawn(driver, capture, frame)
    truth = avatar.render({"right": capture.hand_poses(frame)["right"]}, capture.camera(frame))
    assert psnr(found, truth[..., :3], truth[..., 3]) > 30.0


def test_without_webgl_a_picture_is_shown(page: Path, tmp_path: Path) -> None:
    with open_page(page, tmp_path, flags=("--disable-3d-apis",)) as driver:
        assert driver.execute_script(
            "const i = document.querySelector('#fallback img');"
            "return i.checkVisibility() && i.naturalWidth > 0"
        )


def test_gaussians_of_a_frame_are_those_that_the_fit_draws(make_training: Any) -> None:
    training = make_training("right")
    settings = read_settings({**QUICK, "visibility.enabled": False, "light.enabled": False})
    fit = make_fit(training, settings, 0, torch.device("cpu"))
    with torch.no_grad():
        fit.model.biases_of("right").psi.bias.fill_(1.0)
        fit.model.log_gains.fill_(-0.3)
        row = torch.tensor([4])
        drawn = fit.draw(StepBatch(row))
        frame = int(fit.data.frames.indices[4])
        avatar = fit.avatar(0)
        given = avatar.posed({"right": training.hand_poses(frame)["right"]})["right"]
        made, _ = fit.model.gaussians("right", *given, rows=row)
        camera = training.camera(frame)
        image, _, _ = rasterize(
            made.means,
            made.quats,
            made.scales,
            made.opacities,
            made.colors,
            fit.clip.viewmats[row],
            fit.clip.Ks[row],
            camera.width,
            camera.height,
        )
    np.testing.assert_allclose(image.numpy(), drawn.image.numpy(), atol=2e-4)
    assert float(drawn.image.max()) > 0.1


def test_weights_are_those_of_the_places_in_the_masks(fitted, folder: Path) -> None:
    avatar, capture = fitted
    frame = avatar.record.frames[0]
    camera, hand = capture.camera(frame), capture.hand_poses(frame)["right"]
    mask = np.zeros((camera.height, camera.width), np.uint8)
    middle = camera.width // 2
    mask[:, middle:] = 255
    found = mean_weights(avatar, capture, {frame: mask})["right"]
    shown = np.isfinite(found)
    assert 0.2 < shown.mean() < 0.8
    anchors = avatar.model.rigs["right"].pose(*avatar.posed({"right": hand})["right"])
    turn, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    places = anchors.positions[0].double().numpy()
    pixels, _ = cv2.projectPoints(places, cv2.Rodrigues(turn)[0], shift, camera.K, None)
    x = pixels[shown, 0, 0]
    # A pixel away from the edge the weight is exactly that of the mask's half.
    assert (found[shown][x > middle + 1] == 1.0).all()
    assert (found[shown][x < middle - 1] == 0.0).all()
    assert mean_weights(avatar, capture, {}) == {}
    # A folder remembers the masks of its fit.
    kept, known = load_avatar(folder).weight_masks, avatar.weight_masks
    assert sorted(kept) == sorted(known)
    np.testing.assert_array_equal(kept[frame], known[frame])


def test_frames_are_played_at_the_pace_at_which_they_were_recorded(fitted) -> None:
    """Oracle: the times of the capture, also where frames are left out."""
    avatar, capture = fitted
    count = len(capture)
    times = np.cumsum([0.0, *np.resize([0.033, 0.067, 0.035], count - 1)])
    slow = Capture(
        capture.root,
        dataclasses.replace(capture.info, times=tuple(times)),
        capture.hands,
        capture.cameras,
    )
    for most in (240, 5):
        settings = dataclasses.replace(SMALL, most_frames=most)
        samples = sample_poses(avatar, slow, settings)
        assert len(samples.shown) == len(samples.frames) <= most
        np.testing.assert_allclose(samples.shown[:-1], np.diff(times[samples.frames]))
        assert samples.shown[-1] == pytest.approx(1 / 30)


def test_a_turned_camera_opens_on_the_same_side(fitted) -> None:
    """As the cameras of InterHand2.6M are turned in their world."""
    avatar, capture = fitted
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("yx", [90.0, 20.0], degrees=True).as_matrix()
    cameras = replace(capture.cameras, viewmats=turn @ capture.cameras.viewmats)
    moved = Capture(capture.root, capture.info, capture.hands, cameras)

    def seen(given: Capture) -> np.ndarray:
        made = sample_poses(avatar, given, SMALL)
        wrist = Rotation.from_rotvec(made.start["right"].pose[0]).as_matrix()
        return made.viewmat[:3, :3] @ wrist

    np.testing.assert_allclose(seen(moved), seen(capture), atol=1e-6)


def test_another_import_of_the_same_id_is_refused(fitted) -> None:
    """As a second `wildghand fit VIDEO` leaves it that was stopped in its fit."""
    avatar, capture = fitted
    hand = capture.hands["right"]
    other = {"right": replace(hand, pose=hand.pose[::-1].copy())}
    again = Capture(capture.root, capture.info, other, capture.cameras)
    with pytest.raises(UsageError, match="is not the import of"):
        sample_poses(avatar, again, SMALL)


def test_the_command_says_what_it_wrote(fitted, folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "rest.html"
    given = ["page", str(folder), "-o", str(out), "--json"]
    assert main(given) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["bytes"] == out.stat().st_size
    assert facts["frames"] == 0
    model = fitted[0].model
    assert facts["gaussians"] == len(model.rigs["right"]) + len(model.wall("right"))
    assert "http" not in out.read_text("utf-8").replace("http://www.w3.org/2000/svg", "").replace(
        "http-equiv", ""
    )
    assert main(given) == 2


def test_what_cannot_be_shown_is_refused(fitted, folder: Path, page: Path, tmp_path: Path) -> None:
    avatar, capture = fitted
    with pytest.raises(UsageError, match="exists"):
        write_page(folder, page)
    with pytest.raises(HwpError, match="is not an avatar"):
        write_page(tmp_path, tmp_path / "a.html")
    record = dataclasses.replace(avatar.record, source={"capture": "another"})
    other = WildGHandAvatar(
        avatar.model,
        avatar.settings,
        avatar.hand_model,
        avatar.betas,
        avatar.mean_color,
        avatar.seed,
        record,
    )
    with pytest.raises(UsageError, match="'another'"):
        sample_poses(other, capture, SMALL)
