"""Figures. Oracles: the XML parser, values that are put in, the style sheet's own colours."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_results import made_results
from small_captures import CaptureMaker

from hwp_bench.analysis.bootstrap import Estimate
from hwp_bench.analysis.cost import analyse_cost
from hwp_bench.analysis.pairing import group_runs
from hwp_bench.report.figures import (
    PALETTE,
    StripMethod,
    bands_text,
    bars_by_perturbation,
    draw_bars,
    draw_leads,
    draw_pareto,
    inline_svg,
    strip_plot,
    write_cost,
    write_figure,
)
from hwp_bench.report.page import style_sheet
from hwp_bench.results import Results
from hwp_bench.taxonomy import perturbation

HOSTILE = 'a $x^2$ </title><script>"&'


def analysis(*names: str):
    """Methods that gain 1 dB at 1, 2, 4, 8 s; each starts 1 dB above the one before."""
    curves = [[(2.0**k, 15.0 + n + k) for k in range(4)] for n in range(len(names))]
    made = [
        made_results(name, lambda c, f, s: 20.0, curve=curve, seconds=8.0)
        for name, curve in zip(names, curves, strict=True)
    ]
    return analyse_cost(group_runs(made), "psnr")


def estimate(value: float, low: float | None = None, high: float | None = None) -> Estimate:
    return Estimate(value, low, high, None, None, None, 4)


def drawn(svg: str) -> ET.Element:
    return ET.fromstring(svg)


def words(root: ET.Element) -> list[str]:
    return [item.text or "" for item in root.iter("text")]


def of_class(root: ET.Element, name: str) -> list[ET.Element]:
    return [item for item in root.iter() if item.get("class") == name]


def test_the_palette_is_that_of_the_style_sheet() -> None:
    style = style_sheet()
    light = style[: style.index("@media")]
    assert dict(PALETTE).items() <= dict(re.findall(r"--(\w+): (#\w+)", light)).items()
    dark = style[style.index("@media") : style.index("img {")]
    assert set(PALETTE) <= set(re.findall(r"--(\w+):", dark))


def test_a_figure_in_a_page_has_words_a_title_and_the_colours_of_the_page() -> None:
    found = analysis("mine", "plain")
    figure = draw_pareto(found.curves, found.front, "psnr", {"Mine": 0, "Plain": 1})
    svg = inline_svg(figure, HOSTILE)
    root = drawn(svg)
    assert root.tag == "svg"
    assert root.get("role") == "img"
    assert root.get("aria-label") == root.find("title").text == HOSTILE
    assert "PSNR [dB], validation frames" in words(root)
    assert "seconds of fitting (log)" in words(root)
    assert {"1", "2", "5"} <= set(words(root))
    # Nothing is loaded, nothing rules the page around it, no colour is fixed.
    assert not re.search(r"url\(|https?:|<style|<script|clip-path", svg)
    assert not re.search(r"#[0-9a-f]{6}\b(?!-)", re.sub(r'(id|href)="[^"]*"', "", svg))
    assert {"var(--s0)", "var(--s1)", "var(--front)"} <= set(re.findall(r"var\(--\w+\)", svg))
    assert len(of_class(root, "front")) == len(found.front)
    assert len(of_class(root, "band")) == 2


def test_two_captures_have_lines_and_no_bands() -> None:
    made = made_results("mine", lambda c, f, s: 20.0, captures=2)
    found = analyse_cost(group_runs([made]), "psnr")
    figure = draw_pareto(found.curves, found.front, "psnr")
    assert figure.legends[0].get_title().get_text().startswith("No intervals: of fewer than 3")
    assert of_class(drawn(inline_svg(figure, "t")), "band") == []


def test_of_many_methods_only_the_ends_of_the_front_have_bands() -> None:
    # Each method begins after the one before has, and above it: all are on the front.
    made = [
        made_results(
            f"m{n}",
            lambda c, f, s: 20.0,
            curve=[(2.0**k, 15.0 + 2 * n) for k in range(n, 6)],
            seconds=32.0,
        )
        for n in range(5)
    ]
    found = analyse_cost(group_runs(made), "psnr")
    assert len({part.label for part in found.front}) == 5
    figure = draw_pareto(found.curves, found.front, "psnr", {f"M{n}": n for n in range(5)})
    assert len(of_class(drawn(inline_svg(figure, "t")), "band")) == 2
    assert bands_text(found.curves).endswith("of the first and the last method on the front")


def test_names_of_two_figures_on_a_page_differ_and_every_reference_is_there() -> None:
    found = analysis("mine")
    figure = draw_pareto(found.curves, found.front, "psnr", {"Mine": 0})
    first, second = (drawn(inline_svg(figure, title)) for title in ("a", "b"))
    names = [{item.get("id") for item in root.iter()} - {None} for root in (first, second)]
    assert names[0]
    assert not names[0] & names[1]
    for root, own in zip((first, second), names, strict=True):
        used = {item.get("href") for item in root.iter()} - {None}
        assert used == {f"#{name}" for name in own}
    assert inline_svg(figure, "a") == inline_svg(figure, "a")


def test_bars_are_as_long_as_their_values_and_long_intervals_are_cut() -> None:
    bars = [estimate(10.0, 5.0, 12.0), estimate(20.0, -40.0, 90.0)]
    root = drawn(inline_svg(draw_bars({"Motion Blur": bars, "Light": [estimate(5)]}, "psnr"), "t"))
    assert words(root) == ["Motion Blur", "10.00", "20.00", "Light", "5.00"]
    lengths = []
    for bar in of_class(root, "bar"):
        points = np.array(re.findall(r"[ML] (\S+) (\S+)", bar.find("path").get("d")), float)
        lengths.append(np.ptp(points[:, 0]))
    assert lengths == pytest.approx([lengths[1] / 2, lengths[1], lengths[1] / 4], abs=0.02)
    # The axis ends at 1.35 times the longest bar.
    assert lengths[1] == pytest.approx(390 / 1.35, abs=0.02)
    ends = [
        float(x)
        for item in of_class(root, "whisker")
        for x, _ in re.findall(r"[ML] (\S+) (\S+)", item.find("path").get("d"))
    ]
    assert (min(ends), max(ends)) == (8.0, 398.0)


def test_lower_is_better_downwards() -> None:
    curves = analysis("mine").curves
    up, down = (
        draw_pareto(curves, (), metric).axes[0].get_ylim() for metric in ("psnr", "lpips_alex")
    )
    assert up == down[::-1]
    assert up[0] < up[1]


def test_files_have_a_legend_and_repeat_byte_for_byte(tmp_path: Path) -> None:
    found = analysis("mine", "plain")
    for folder in ("a", "b"):
        written = write_cost(tmp_path / folder, found)
        assert [path.name for path in written] == ["pareto.png", "pareto.svg"]
    for name in ("pareto.png", "pareto.svg"):
        first, second = (tmp_path / folder / name for folder in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()
        assert first.stat().st_size > 10_000
    assert (tmp_path / "a" / "tables" / "cost.tex").is_file()
    figure = draw_pareto(found.curves, found.front, "psnr")
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["Pareto front", "Mine", "Plain"]
    title = figure.legends[0].get_title()
    assert title.get_text() == "Shaded bands are 95 % intervals over captures"
    assert write_figure(tmp_path, "again", figure)[1].read_bytes() == first.read_bytes()


def test_leads_have_a_bar_from_zero_an_interval_and_a_number_each() -> None:
    leads = [("A", estimate(2.0, 1.0, 4.0)), ("B", estimate(-1.0, -3.0, 0.5)), ("C", estimate(0.5))]
    (axes,) = draw_leads("Mine", leads, "psnr").axes
    bars = [(bar.get_x(), bar.get_width(), bar.get_alpha()) for bar in axes.patches]
    # Pale where the interval contains 0, or there is none.
    assert bars == [(0.0, 2.0, 1.0), (0.0, -1.0, 0.4), (0.0, 0.5, 0.4)]
    whiskers = [np.ptp(lines.get_segments()[0][:, 0]) for lines in axes.collections]
    assert whiskers == [3.0, 3.5]
    texts = [text.get_text() for text in axes.texts]
    assert {"A", "B", "C", "+2.00", "-1.00", "+0.50"} <= set(texts)
    assert "Mine ahead in PSNR [dB]" in texts
    low, high = axes.get_xlim()
    assert low < -3.0
    assert high > 4.0


def test_severities_stand_at_their_frames(
    make_capture: CaptureMaker, make_results: Callable[..., Results]
) -> None:
    info = make_capture("capture2").info  # 20 frames, severity 3 in 1, 5, 9, 13, 17
    method = StripMethod(0, "Mine", make_results("mine").captures[0], {})
    root = drawn(str(strip_plot([method], info, "psnr")))
    lefts = []
    for item in of_class(root, "severity"):
        path = item.find("path")
        assert path is not None
        places = re.findall(r"[ML] (\S+) (\S+)", path.get("d") or "")
        lefts.append(min(float(x) for x, _ in places))
    assert lefts == pytest.approx([44 + 406 * frame / 20 for frame in (1, 5, 9, 13, 17)], abs=0.02)


def test_bars_are_of_each_method_and_perturbation() -> None:
    made = [
        made_results(name, lambda c, f, s, level=level: level + c)
        for name, level in (("mine", 20.0), ("plain", 10.0))
    ]
    root = drawn(str(bars_by_perturbation(group_runs(made), "psnr")))
    heads = [perturbation(name).heading for name in ("illumination", "motion_blur")]
    assert words(root) == [heads[0], "20.50", "10.50", heads[1], "22.50", "12.50"]
