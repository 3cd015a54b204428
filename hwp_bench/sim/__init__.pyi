"""The public names of `hwp_bench.sim` and the modules that they come from; see `__init__.py`."""

from .produce.production import render_capture
from .produce.suites import SuiteItem, ensure_suite, suite
from .render.frame import render_frame
from .scene.reader import load_scene, scene_names
from .scene.schema import Scene

__all__ = [
    "Scene",
    "SuiteItem",
    "ensure_suite",
    "load_scene",
    "render_capture",
    "render_frame",
    "scene_names",
    "suite",
]
