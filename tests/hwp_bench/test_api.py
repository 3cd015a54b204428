"""The front door of the toolkit. Oracle: a fresh interpreter, and the commands' own functions."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker

import hwp_bench
from hwp_bench import api
from hwp_bench.capture import Capture
from hwp_bench.metrics import METRICS
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network, score_frame
from hwp_bench.results import Results, write_results

METHOD = '''
import numpy as np


class Gray:
    """Draws every pixel in one gray."""

    def __init__(self, settings, seed):
        self.gray = settings["gray"]

    def fit(self, training, budget, report):
        report(0, self)
        return self

    def render(self, hands, camera):
        return np.full((camera.height, camera.width, 4), self.gray, np.float32)
'''


@pytest.fixture
def gray_method(tmp_path: Path) -> Path:
    folder = tmp_path / "gray"
    folder.mkdir()
    (folder / "gray_method.py").write_text(METHOD)
    (folder / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "gray"\n[entry]\npython = "gray_method:Gray"\n'
        "[presets.default]\ngray = 0.5\n"
    )
    return folder


def test_the_import_is_light() -> None:
    code = (
        "import sys, hwp_bench, wildghand\n"
        "print([name for name in ('numpy', 'torch') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("package", ["hwp_bench", "wildghand"])
def test_every_name_is_there_and_is_listed(package: str) -> None:
    module = __import__(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        module.nothing  # noqa: B018


@pytest.mark.parametrize("package", ["hwp_bench", "wildghand"])
def test_type_checkers_see_the_same_names(package: str) -> None:
    module = __import__(package)
    tree = ast.parse(Path(str(module.__file__)).read_text("utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    names = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert names == module._HOMES


def test_evaluate_takes_captures_and_folders_and_resumes(
    gray_method: Path, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=20, size=48)
    results = hwp_bench.evaluate(gray_method, capture, tmp_path / "out", settings={"gray": 0.25})
    assert results.method.settings == {"gray": 0.25}
    assert results.captures[0].failure is None
    assert (tmp_path / "out" / "tables" / "overall.md").is_file()
    again = hwp_bench.evaluate(
        gray_method, [capture.root], tmp_path / "out", settings={"gray": 0.25}
    )
    assert again.captures == results.captures
    assert hwp_bench.read_results(tmp_path / "out") == again
    psnr = results.captures[0].frames[0].scores["psnr"]
    assert results.scores["psnr"] == pytest.approx(psnr, abs=1.0)
    assert repr(results).startswith("Results(gray on captures, 1 capture, seed 0, PSNR ")
    with pytest.raises(hwp_bench.HwpError, match="is not a setting of plain"):
        hwp_bench.evaluate("plain", "mini", settings={"stps": 3})


class Gray:
    """The method of `METHOD`, as a class of this file."""

    def __init__(self, settings, seed):
        self.gray = settings["gray"]

    def fit(self, training, budget, report):
        report(0, self)
        return self

    def render(self, hands, camera):
        return np.full((camera.height, camera.width, 4), self.gray, np.float32)


def make_gray(settings, seed):
    return Gray(settings, seed)


def test_a_class_or_function_scores_as_the_same_method_in_a_directory(
    gray_method: Path, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture, settings = make_capture(frames=20, size=48), {"gray": 0.25}
    expected = hwp_bench.evaluate(gray_method, capture, tmp_path / "directory", settings=settings)
    for factory in (Gray, make_gray):
        out = tmp_path / factory.__name__
        found = hwp_bench.evaluate(factory, capture, out, settings=settings)
        assert found.method.name == factory.__name__
        (one,), (other,) = found.captures, expected.captures
        assert (one.frames, one.predictions_digest) == (other.frames, other.predictions_digest)
        assert one.isolation == other.isolation
        # The same source is the same method, so that what is finished is taken as it is.
        again = hwp_bench.evaluate(factory, capture, out, settings=settings)
        assert again.captures == found.captures
    with pytest.raises(hwp_bench.HwpError, match="cannot be made: KeyError: 'gray'"):
        hwp_bench.evaluate(Gray, capture, tmp_path / "fails")
    with pytest.raises(hwp_bench.HwpError, match="not a class or function at the top level"):
        hwp_bench.evaluate(lambda settings, seed: None, capture)


def test_a_table_that_is_given_in_part_keeps_the_rest(
    gray_method: Path, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    manifest = gray_method / "method.toml"
    manifest.write_text(manifest.read_text() + "light = { degree = 2, rate = 0.1 }\n")
    capture = make_capture(frames=20, size=48)
    changes = {"light": {"rate": 0.2}}
    results = hwp_bench.evaluate(gray_method, capture, tmp_path / "out", settings=changes)
    assert results.method.settings == {"gray": 0.5, "light": {"degree": 2, "rate": 0.2}}


def test_dotted_names_reach_a_method_as_tables(
    gray_method: Path, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    # Oracle: the table that a reader of TOML makes of the same names.
    manifest, source = gray_method / "method.toml", gray_method / "gray_method.py"
    manifest.write_text(manifest.read_text() + "light.degree = 2\nlight.rate = 0.1\n")
    expected = {"gray": 0.5, "light": {"degree": 0, "rate": 0.1}}
    line = f"        assert settings == {expected}, settings\n"
    source.write_text(METHOD.replace("        self.gray", line + "        self.gray"))
    # It is made twice: before the first capture, and to fit it.
    capture, changes = make_capture(frames=20, size=48), {"light.degree": 0}
    results = hwp_bench.evaluate(gray_method, capture, tmp_path / "out", settings=changes)
    assert results.captures[0].failure is None


def test_score_takes_float_images(make_capture: CaptureMaker) -> None:
    capture = make_capture(frames=20, size=48)
    image, mask = capture.frame(0), capture.mask(0)
    gray = np.full_like(image, 128)
    expected = score_frame(gray, image, mask, networks=load_available())
    assert hwp_bench.score(gray, image, mask) == expected
    assert hwp_bench.score(gray / np.float32(255), image / 255.0, mask) == expected
    assert hwp_bench.score(image, image, mask)["psnr"] == 100.0


def test_score_has_the_metrics_of_an_evaluation(
    make_capture: CaptureMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: what an evaluation scores with the same distances, which are the mean error here.
    asked = []

    def load() -> dict[str, Network]:
        asked.append(1)
        return dict.fromkeys(("alex", "vgg", "flip"), lambda a, b: float(abs(a - b).mean()))

    capture = make_capture(frames=20, size=48)
    image, mask = capture.frame(0), capture.mask(0)
    dark = image // 2
    api._networks.cache_clear()
    monkeypatch.setattr(api, "load_available", load)
    scores = [hwp_bench.score(dark, image, mask) for _ in range(2)]
    api._networks.cache_clear()
    assert scores == [score_frame(dark, image, mask, networks=load())] * 2
    assert {one.name for one in METRICS} == set(scores[0])
    # The weights are read once, and by the oracle.
    assert len(asked) == 2


def test_compare_takes_results_and_folders(
    make_results: Callable[..., Results], tmp_path: Path
) -> None:
    first = make_results()
    second = replace(first, method=replace(first.method, name="other", title="Other"))
    write_results(tmp_path / "results.json", second)
    found = hwp_bench.compare(first, tmp_path, metrics=["psnr"], resamples=200)
    assert found.metrics["psnr"].differences[0].scope == "macro"
    assert all(item.estimate.value == 0.0 for item in found.metrics["psnr"].differences)
    assert "| Other |" in str(found)
    assert repr(found).startswith("Comparison(")
    with pytest.raises(hwp_bench.HwpError, match="only one method"):
        hwp_bench.compare(first)
    with pytest.raises(hwp_bench.HwpError, match="no result to compare"):
        hwp_bench.compare()


def test_a_capture_gives_poses_and_cameras_and_says_what_it_is(make_capture: CaptureMaker) -> None:
    capture = hwp_bench.open_capture(make_capture("mine", frames=20, size=48).root)
    assert isinstance(capture, Capture)
    assert "mine" in repr(capture)
    pose, camera = capture.hand_poses(3)["right"], capture.camera(3)
    np.testing.assert_array_equal(pose.pose, capture.hands["right"].pose[3])
    assert (camera.width, camera.height) == (48, 48)
