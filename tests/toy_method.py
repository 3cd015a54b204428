"""A method with two components whose effects and costs are known; it fits nothing."""

from __future__ import annotations

from pathlib import Path

_SCRIPT = """
import json, pathlib, sys
import cv2, numpy as np
request, output = map(pathlib.Path, sys.argv[1:])
value = json.loads((request / "request.json").read_text())
settings, split, seed = value["settings"], value["split"], value["seed"]
try:
    with open(pathlib.Path(__file__).parent.parent / "fits.log", "a") as stream:
        stream.write(f"{value['id']} {seed} {settings['tone']} {settings['edge']} "
                     f"{settings['mask']}\\n")
except OSError:
    pass  # in a sandbox
if settings.get("fail") == value["id"]:
    sys.exit("no luck")
error = 10 + 30 * (not settings["tone"]) + 10 * (not settings["edge"]) + 5 * settings["mask"] + seed
def write(folder, frames, error):
    folder.mkdir(parents=True)
    for frame in frames:
        level = np.full((value["height"], value["width"], 3), 150 - error, np.uint8)
        cv2.imwrite(str(folder / f"{frame:06d}.png"), level)
write(output / "predictions", range(*split["test"]), error)
frames = list(range(*split["validation"]))
write(output / "checkpoints" / "000", frames, 100)
write(output / "checkpoints" / "001", frames, error)
seconds = 2.0 * (1.5 if settings["tone"] else 1) * (1.2 if settings["edge"] else 1)
times = [{"step": 50, "seconds": 1.0, "peak_memory": 1000},
         {"step": 100, "seconds": seconds, "peak_memory": 2000}]
(output / "run.json").write_text(json.dumps({"fit_seconds": seconds, "render_seconds": 0.25,
    "steps": 100, "peak_memory": 2000, "device": "cpu", "checkpoint_frames": frames,
    "checkpoints": times}))
"""

_MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "toy"
title = "Toy"
[entry]
command = ["{python}", "{method}/run.py", "{request}", "{output}"]
[presets.default]
tone = true
edge = true
mask = false
[switches.tone]
title = "Tone"
settings_off = {tone = false}
[switches.edge]
title = "Edge"
settings_off = {edge = false}
[switches.hard-mask]
title = "Hard mask"
settings_on = {mask = true}
"""


def write_toy_method(folder: Path) -> Path:
    """Write the method directory and return it.

    `tone` makes every pixel 30 levels better and a fit 1.5 times as long, `edge` 10 levels and
    1.2 times; `hard-mask` makes it 5 levels worse. A full fit takes 3.6 s on its own clock.
    Every fit without a sandbox is a line of `fits.log` next to the folder.
    """
    folder.mkdir()
    (folder / "run.py").write_text(_SCRIPT)
    (folder / "method.toml").write_text(_MANIFEST)
    return folder
