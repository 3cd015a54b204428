"""The public names of `hwp_bench.sim` and the modules that they come from; see `__init__.py`."""

from .produce.capture import SuiteItem as SuiteItem
from .produce.capture import ensure_suite as ensure_suite
from .produce.capture import render_capture as render_capture
from .produce.capture import suite as suite
from .render.frame import render_frame as render_frame
from .scene.scene import Scene as Scene
from .scene_files import load_scene as load_scene
from .scene_files import scene_names as scene_names
