"""A figure as an SVG element of a page: words stay words, colours are the style sheet's."""

from __future__ import annotations

import hashlib
import io
import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

from markupsafe import Markup

from hwp_bench.report.figures import MARK, PALETTE, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def inline_svg(figure: Figure, title: str) -> Markup:
    """Return a figure as an SVG element for a page: words stay words, colours are variables.

    Args:
        figure: the figure.
        title: what it shows, for people who cannot see it.
    """
    stream = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with figure_style(**{"svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata=nothing)
    text = stream.getvalue()
    drawn = ET.fromstring(text)
    # Two figures of one page must not share the names of their markers.
    own = "f" + hashlib.sha256(f"{title}{text}".encode()).hexdigest()[:10] + "-"
    box = drawn.attrib["viewBox"]
    # matplotlib states these two in a style element, which would rule the whole page.
    style = "stroke-linejoin:round;stroke-linecap:butt"
    attributes = {"viewBox": box, "role": "img", "aria-label": title, "class": "plot"}
    root = ET.Element("svg", {**attributes, "style": style})
    ET.SubElement(root, "title").text = title
    for child in drawn:
        _take_over(root, child, own)
    return Markup(ET.tostring(root, encoding="unicode"))


def _take_over(parent: ET.Element, drawn: ET.Element, own: str) -> None:
    """Copy an element without namespaces, clipping and names that nothing refers to."""
    tag = drawn.tag.rpartition("}")[2]
    if tag in ("style", "clipPath", "metadata"):
        return
    made = ET.SubElement(parent, tag)
    for key, value in drawn.attrib.items():
        name = key.rpartition("}")[2]
        if name == "id":
            if value.startswith(MARK):
                made.set("class", value.removeprefix(MARK))
            elif tag != "g":
                made.set("id", own + value)
        elif name == "href":
            made.set("href", "#" + own + value.removeprefix("#"))
        elif name == "style":
            made.set("style", _page_style(value))
        elif name != "clip-path" and not value.startswith("rotate(-0 "):
            short = re.sub(r"-?\d+\.\d+", lambda found: f"{float(found[0]):.2f}", value)
            made.set(name, " ".join(short.split()))
    if tag == "text":
        made.text = drawn.text
    for child in drawn:
        _take_over(made, child, own)
    if tag in ("defs", "g") and not len(made):
        parent.remove(made)


def _page_style(style: str) -> str:
    """Return a style with the page's own font, and its colours as variables."""
    parts = [part for part in style.split("; ") if not part.startswith("font-family")]
    variables = {color: f"var(--{name})" for name, color in PALETTE.items()}
    return re.sub(r"#[0-9a-f]{6}", lambda found: variables.get(found[0], found[0]), ";".join(parts))
