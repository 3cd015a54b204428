"""Opening an avatar. Oracles: the modules of a fresh process; the avatar before it was moved."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import DESCRIPTION, load_avatar, save_avatar
from wildghand.cli.main import main
from wildghand.page import write_page
from wildghand.page.write import PageSettings
from wildghand.viewer.posed_view import PosedView

DRAWN = """
import sys
import wildghand

avatar = wildghand.load_avatar(sys.argv[1])
assert avatar.render("point", size=32)[..., 3].max() > 0.5
print("torch._dynamo" in sys.modules)
"""


def test_an_avatar_is_drawn_without_the_compiler_of_torch(
    tiny_avatar: WildGHandAvatar, tmp_path: Path
) -> None:
    # Its import takes seconds.
    folder = tiny_avatar.folder
    saved = save_avatar(tiny_avatar, tmp_path / "avatar")
    tiny_avatar.folder = folder
    words = [sys.executable, "-c", DRAWN, str(saved)]
    ended = subprocess.run(words, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["False"]


def test_every_use_of_an_avatar_takes_the_hand_model_from_the_place_that_is_given(
    tiny_avatar: WildGHandAvatar, tmp_path: Path
) -> None:
    """As after a move to a machine with MANO in another folder."""
    folder = tiny_avatar.folder
    saved = save_avatar(tiny_avatar, tmp_path / "avatar")
    tiny_avatar.folder = folder
    description = json.loads((saved / DESCRIPTION).read_text())
    description["hand_model"]["source"] = "mano:/old/machine/mano"
    (saved / DESCRIPTION).write_text(json.dumps(description))
    mesh = ["export", str(saved), "--mesh", "--texture", "64", "-o", str(tmp_path / "hand.glb")]
    assert main([*mesh, "--hand-model", "anny"]) == 0
    small = PageSettings(random_samples=8, rank=2, still_size=32)
    assert write_page(saved, tmp_path / "hand.html", hand="anny", settings=small).bytes > 0
    view = PosedView(load_avatar(saved, hand="anny"))
    assert view.names == PosedView(tiny_avatar).names
