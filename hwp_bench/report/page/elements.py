"""Tables and figures as elements of a page; whatever comes from results is escaped."""

from __future__ import annotations

import hashlib
import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from hwp_bench.base.tables import Table
from hwp_bench.report.figures import MARK, PALETTE, figure_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Elements that mark the best and the second best score.
_RANKS = {0: "b", 1: "u"}


def to_html(table: Table) -> Markup:
    """Return a table with its caption and notes: best bold, second underlined."""
    heads = []
    if any(column.group for column in table.columns):
        heads.append(tag("tr", join(_groups(table))))
    titles = [tag("th", _unbroken(column.heading), scope="col") for column in table.columns]
    heads.append(tag("tr", join(titles)))
    bodies: list[Markup] = []
    rows: list[Markup] = []
    for row in range(len(table.rows)):
        if row in table.breaks:
            bodies.append(tag("tbody", join(rows)))
            rows = []
        rows.append(tag("tr", join(_cell(table, row, c) for c in range(len(table.columns)))))
    bodies.append(tag("tbody", join(rows)))
    caption = tag("caption", table.caption)
    grid = tag("table", join([caption, tag("thead", join(heads)), *bodies]))
    # Focusable, so that a wide table can be scrolled with the arrow keys.
    scroll = tag(
        "div", grid, class_="scroll", tabindex="0", role="region", aria_label=table.caption
    )
    return join([scroll, *(tag("p", note, class_="note") for note in table.notes)])


def _groups(table: Table) -> list[Markup]:
    cells: list[tuple[str, int]] = []
    for column in table.columns:
        if cells and cells[-1][0] == column.group:
            cells[-1] = (column.group, cells[-1][1] + 1)
        else:
            cells.append((column.group, 1))
    return [
        tag("th", group, colspan=width, scope="colgroup", class_="group")
        if group
        else tag("td", colspan=width)
        for group, width in cells
    ]


def _unbroken(heading: str) -> str:
    """Return a heading that keeps its arrow and unit on the line of its last word."""
    return heading.replace(" ↑", "\u00a0↑").replace(" ↓", "\u00a0↓").replace(" [", "\u00a0[")


def _cell(table: Table, row: int, column: int) -> Markup:
    value = table.rows[row][column]
    text = table.text(row, column)
    rank = table.rank(row, column)
    content: str | Markup = text if rank is None else tag(_RANKS[rank], text)
    if isinstance(value, int | float) or text == "–":
        return tag("td", content, class_="number")
    return tag("td", content)


def tag(name: str, content: str | Markup = "", **attributes: object) -> Markup:
    """Return one element; attributes, and content that is not `Markup`, are escaped.

    Underscores of attribute names become hyphens, `class_` becomes `class`.
    """
    parts = [
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for key, value in attributes.items()
    ]
    return Markup(f"<{name}{''.join(parts)}>{escape(content)}</{name}>")


def join(parts: Iterable[Markup]) -> Markup:
    """Return parts one after the other."""
    return Markup("").join(parts)


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
