"""The text of a scene with one short episode of three effects, for the simulator's tests."""

from __future__ import annotations

from collections.abc import Callable

from hwp_bench.sim.scene.scene import Scene

#: Makes the scene below, with some texts replaced.
SceneMaker = Callable[..., Scene]

SINGLE = """
id = "tiny"
title = "A small scene"
hands = "right"
action = "Grabbing blocks"
device = "Webcam"
frame_count = 40
fps = 20.0
seed = 5
background = "studio"
noise = 0.01

[subject]
seed = 11
tone = 0.22
age = 31.0

[camera]
handheld = true
field_of_view = 24.0

[light]
direction = [-0.5, -0.9, -0.8]
key = 0.6
sky = 0.35
kelvin = 5200.0

[track]
period = 4.0
right = [
  { gesture = "open" },
  { gesture = "fist", turn = 30.0 },
]

[[effects]]
kind = "hand_object_interaction"
episodes = [[0.05, 0.2, 4]]
[[effects.items]]
object = "block"
anchor = "right"
place = [0.0, -0.02, -0.06]
away = [0.05, 0.0, 0.0]

[[effects]]
kind = "illumination"
episodes = [[0.3, 0.4, 3]]

[[effects]]
kind = "motion_blur"
episodes = [[0.5, 0.6, 3]]
"""

#: Frames of the 40 in which nothing, the object, the light, the shutter acts.
CLEAN, OBJECT, LIGHT, BLUR = 36, 5, 14, 22
