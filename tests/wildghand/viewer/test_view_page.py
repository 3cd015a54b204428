"""The pages of views in a browser. Oracles: `wildghand render` of the pose, the server's state."""

from __future__ import annotations

import dataclasses
import io
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import DESK, open_page
from painted import hand_parameters, painted_info
from PIL import Image

from benchmarks.patience import Patience, spent_by
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Cameras, Capture, CaptureWriter, open_capture
from hwp_bench.hands import HandParameters, load_template
from hwp_bench.importers.video.glimpse import PaintedHand
from wildghand.avatar.avatar import WildGHandAvatar, over
from wildghand.avatar.files import save_avatar
from wildghand.cli.main import main
from wildghand.fitting import fit_capture
from wildghand.viewer.live import serve_fit
from wildghand.viewer.posed_view import Motion
from wildghand.viewer.server import Address
from wildghand.viewer.view import ServedView, ViewSettings, serve_view

pytest.importorskip("viser")
pytestmark = pytest.mark.slow

#: Any free port.
ANYWHERE = Address(port=0)
#: Rows and columns of the window that no panel and no notice of viser's covers.
CLEAR = slice(170, 880), slice(330, 900)
#: Most processor seconds of this process and of Chromium, which draws WebGL in software.
PATIENCE = 480.0
_TYPE = """
const row = [...document.querySelectorAll("label")].find(l => l.textContent === arguments[0]);
for (let at = row; at; at = at.parentElement) {
  const field = at.querySelector("input[type=text], input[inputmode]");
  if (field) { return field; }
}
return null;
"""


def window(driver: Any) -> np.ndarray:
    """(H, W, 3) float, what the window shows."""
    from selenium.common.exceptions import TimeoutException

    def taken() -> bytes | None:
        try:
            return driver.get_screenshot_as_png()
        except TimeoutException:  # after ten seconds, on a machine that is busy
            return None

    data = wait_until(taken)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(float)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """dB of 8-bit pictures over the clear part of the window."""
    error = (first[CLEAR] - second[CLEAR]) / 255.0
    return -10.0 * np.log10(np.square(error).mean() + 1e-12)


def wait_until(done: Callable[[], Any]) -> Any:
    """What `done` gives as soon as it is true."""
    patience = Patience(spent_by(os.getpid()), most=PATIENCE)
    while not (found := done()):
        patience.check()
        time.sleep(0.3)
    return found


def settled(driver: Any, served: ServedView, reached: Callable[[np.ndarray], bool]) -> np.ndarray:
    """The window once the server has sent its full picture and the page shows one."""

    def look() -> list[np.ndarray]:
        if not served.server.get_clients() or not served.screen.still:
            return []
        shown = window(driver)
        return [shown] if reached(shown) else []

    return wait_until(look)[0]


def window_capture(path: Path) -> Capture:
    """Three frames whose camera sees what the browser's window has room for."""
    width, height = DESK, 900
    parameters = hand_parameters("right", 0)
    some = slice(0, 3)
    motion = HandParameters(
        parameters.pose[some], parameters.betas, parameters.transl[some], parameters.valid[some]
    )
    K = np.array([[1260.0, 0.0, width / 2], [0.0, 1260.0, height / 2], [0.0, 0.0, 1.0]])
    clip = Cameras(np.repeat(K[None], 3, 0), np.repeat(np.eye(4)[None], 3, 0))
    info = dataclasses.replace(painted_info("window"), width=width, height=height, frame_count=3)
    with CaptureWriter(path, info, {"right": motion}, clip) as writer:
        for frame in range(3):
            writer.frame(frame, np.zeros((height, width, 3), dtype=np.uint8))
            writer.mask(frame, np.zeros((height, width), dtype=np.uint8))
    return open_capture(path)


def test_the_page_shows_what_render_draws_and_a_slider_poses_the_hand(
    tiny_avatar: WildGHandAvatar, tmp_path: Path
) -> None:
    capture = window_capture(tmp_path / "capture")
    save_avatar(tiny_avatar, tmp_path / "avatar")
    words = ["render", str(tmp_path / "avatar"), "--poses", str(capture.root), "--range", "0"]
    assert main([*words, "--background", "255", "-o", str(tmp_path / "frames")]) == 0
    rendered = read_rgb(tmp_path / "frames" / "000000.png").astype(float)
    motion = Motion(tiny_avatar, capture)
    with (
        serve_view(tiny_avatar, motion, ANYWHERE, ViewSettings(edge=1280)) as served,
        open_page(served.url, tmp_path / "profile", webgl=True) as driver,
    ):
        from selenium.webdriver import ActionChains
        from selenium.webdriver.common.keys import Keys

        shown = settled(driver, served, lambda got: psnr(got, rendered) >= 30.0)
        hands = served.view.hands

        field = wait_until(lambda: driver.execute_script(_TYPE, "index1 flexion"))
        field.click()
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys("70", Keys.ENTER)

        def flexion() -> float:
            """Of the first joint of the index finger; each typed digit is sent at once."""
            pose = served.view.hands["right"].pose
            return float(served.view.angles["right"].angles(pose)[1, 0])

        wait_until(lambda: served.view.hands is not hands and flexion() > 60.0)
        assert flexion() == pytest.approx(70.0)
        bent = over(tiny_avatar.render(served.view.hands, motion.camera(0)), (255, 255, 255))
        assert psnr(bent, rendered) < 28.0
        after = settled(driver, served, lambda got: psnr(got, bent) >= 30.0)
        assert psnr(after, shown) < 28.0

        # A drag over the picture moves the camera, and the picture follows.
        (client,) = served.server.get_clients().values()
        before = client.camera.position
        chain = ActionChains(driver).move_by_offset(600, 500).click_and_hold()
        chain.move_by_offset(120, 0).release().perform()
        wait_until(lambda: np.linalg.norm(client.camera.position - before) > 0.05)
        turned = settled(driver, served, lambda got: psnr(got, after) < 25.0)
        assert turned[CLEAR].min() < 200.0


def test_the_page_of_a_fit_shows_its_steps_and_pictures(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    settings = {
        "gaussians": 400,
        "device": "cpu",
        "network.identity_resolution": 24,
        "network.plane_resolution": 12,
        "schedule.steps": 5,
    }
    with (
        serve_fit(ANYWHERE, pause=0.0) as served,
        open_page(served.url, tmp_path / "profile", webgl=True) as driver,
    ):
        wait_until(lambda: served.server.get_clients())
        # While a video is imported: the hand in its colours, here red.
        hand = load_template()
        red = np.tile(np.array([255, 0, 0], np.uint8), (len(hand.vertices), 1))
        served.glimpse([PaintedHand(hand.vertices, hand.faces, red)])

        def reds() -> int:
            # Redder than the skin of the painted frames.
            pixels = window(driver).astype(int)
            return int((pixels[..., 0] > 60 + 3 * pixels[..., 1:].max(axis=-1)).sum())

        wait_until(lambda: reds() > 2000)
        fit_capture(make_painted().root, settings=settings, watch=served.watch)
        text = "return document.body.textContent"
        words = wait_until(lambda: "step 5" in (found := driver.execute_script(text)) and found)
        assert "loss" in words
        assert "dB" in words
        # The painted frames stand before a gray wall of 0.35.
        wall = np.array([0.35 * 255.0] * 3)
        wait_until(lambda: (np.abs(window(driver) - wall).max(axis=-1) < 8.0).sum() > 10_000)
        wait_until(lambda: reds() < 200)
