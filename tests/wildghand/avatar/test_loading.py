"""Opening an avatar. Oracle: the modules of a fresh process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import save_avatar

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
