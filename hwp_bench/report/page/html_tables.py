"""A table as HTML: escaped, best bold, second underlined, groups over their columns."""

from __future__ import annotations

from collections.abc import Iterable

from markupsafe import Markup, escape

from hwp_bench.base.tables import Table

_RANKS = {0: "b", 1: "u"}


def to_html(table: Table) -> Markup:
    """Return a table with its caption and notes."""
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
