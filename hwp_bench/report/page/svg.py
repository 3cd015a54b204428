"""Small SVG drawings as safe text: numbers, escaped words, colours left to the style sheet."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from markupsafe import Markup, escape

#: Width of every drawing in its own units; the page scales it.
WIDTH = 460
#: Number of series that the style sheet has a colour and a dash for.
SERIES = 8


def number(value: float) -> str:
    """Return a coordinate with at most two digits after the point."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def tag(name: str, content: str | Markup = "", **attributes: object) -> Markup:
    """Return one element; every attribute and every content that is no `Markup` is escaped.

    Underscores of attribute names become hyphens, `class_` becomes `class`; floats are shortened.
    """
    parts = []
    for key, value in attributes.items():
        text = number(value) if isinstance(value, float) else str(value)
        parts.append(f' {key.rstrip("_").replace("_", "-")}="{escape(text)}"')
    opening = f"<{name}{''.join(parts)}"
    inner = escape(content)
    return Markup(f"{opening}>{inner}</{name}>") if inner else Markup(f"{opening}/>")


def join(parts: Iterable[Markup]) -> Markup:
    """Return parts one after the other."""
    return Markup("").join(parts)


def label(x: float, y: float, text: str, anchor: str = "start", class_: str = "tick") -> Markup:
    """Return a word at a place."""
    return tag("text", text, x=float(x), y=float(y), text_anchor=anchor, class_=class_)


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Markup:
    """Return a straight line."""
    return tag("line", x1=float(x1), y1=float(y1), x2=float(x2), y2=float(y2), class_=class_)


def polyline(points: Sequence[tuple[float, float]], class_: str, name: str = "polyline") -> Markup:
    """Return a line through points, or with `name` "polygon" the area that it encloses."""
    spelled = " ".join(f"{number(x)},{number(y)}" for x, y in points)
    return tag(name, points=spelled, class_=class_)


def drawing(height: float, title: str, parts: Iterable[Markup]) -> Markup:
    """Return a whole drawing, `WIDTH` wide, with a title for people who cannot see it."""
    content = join([tag("title", title), *parts])
    box = f"0 0 {WIDTH} {number(height)}"
    return tag("svg", content, viewBox=box, role="img", class_="plot")


def series(index: int) -> str:
    """Return the class of the colour and dash of a method."""
    return f"s{index % SERIES}"


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Return about `count` round numbers within [low, high], which must be finite."""
    span = high - low
    if span <= 0:
        return [low]
    step = 10 ** math.floor(math.log10(span / count))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (factor * step) <= count)
    first = math.ceil(low / step - 1e-9)
    return [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return the 1, 2, 5 x 10^n within [low, high]; with few of them in it, its ends instead."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [factor * 10.0**n for n in exponents for factor in (1, 2, 5)]
    inside = [value for value in found if low <= value <= high]
    if len(inside) > 7:
        inside = [value for value in inside if f"{value:e}".startswith("1")]
    return inside if len(inside) > 1 else [low, high]
