"""Values that strangers' files hold, for hypothesis: put anywhere into a file that is sound."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

#: Values that once broke a reader, a sum, a table or a terminal.
NOTED: tuple[Any, ...] = (
    "\ud800",
    "\udcff",
    "\x1b[2J",
    "\u202e",
    "=1+1",
    "<script>alert(1)</script>",
    "../../x",
    "$\\frac{",
    "",
    "x" * 1000,
    "x" * 100_000,
    10**30,
    2**63,
    -1,
    0,
    1e308,
    -1e308,
    5e-324,
    1e9,
    None,
    True,
    [],
    {},
    [[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]],
    {"a": 1e308},
)

#: Any JSON value, text that is not Unicode and numbers that overflow among them.
ANY = st.sampled_from(NOTED) | st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(), max_size=30)
    | st.text(st.characters(categories=["Cs", "Cc"]), min_size=1, max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


def places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of every value inside a JSON value; of long lists those of the first items."""
    if here:
        yield here
    parts = value.items() if isinstance(value, dict) else ()
    parts = enumerate(value[:2]) if isinstance(value, list) else parts
    for key, item in parts:
        yield from places(item, (*here, key))


@st.composite
def edited(draw: st.DrawFn, value: Any, most: int = 3) -> Any:
    """A sound JSON value in which one to `most` parts are replaced, removed, added or repeated."""
    made = copy.deepcopy(value)
    listed = list(places(value))
    for _ in range(draw(st.integers(1, most))):
        *path, last = draw(st.sampled_from(listed))
        holder = made
        try:
            for key in path:
                holder = holder[key]
            match draw(st.sampled_from(("replace", "replace", "replace", "remove", "add"))):
                case "replace":
                    holder[last] = copy.deepcopy(draw(ANY))
                case "remove":
                    del holder[last]
                case _ if isinstance(holder, dict):
                    holder[draw(st.text(max_size=5))] = copy.deepcopy(draw(ANY))
                case _:
                    holder.append(copy.deepcopy(holder[last]))
        except (KeyError, IndexError, TypeError, AttributeError):
            continue  # an earlier edit took the place away
    return made


def as_json(value: Any) -> str:
    """The text of a file with that value; text that is not Unicode is written as escapes."""
    return json.dumps(value)
