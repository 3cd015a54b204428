"""Objects that hands hold: looked up by name, built only when a scene shows them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

from hwp_bench.base.errors import BadInput
from hwp_bench.sim.geometry.surface import Surface

# Name of each object and the module that builds it.
_MODULES: Mapping[str, str] = MappingProxyType(
    {
        "block": "held",
        "pen": "held",
        "sticker": "paper",
        "lotion_tube": "worn",
        "lotion": "worn",
        "watch": "worn",
        "phone": "held",
        "card": "paper",
        "mug": "kitchen",
        "ball": "kitchen",
        "spoon": "kitchen",
        "banana": "kitchen",
        "remote": "household",
        "bottle": "household",
        "brush": "household",
        "notebook": "household",
    }
)


@dataclass(frozen=True)
class ObjectRequest:
    """One object as a scene asks for it."""

    #: Name of the object.
    name: str
    #: Chooses among the variants of this object.
    variant: int = 0


def object_names() -> tuple[str, ...]:
    """Names of the objects that a scene can show."""
    return tuple(_MODULES)


def check_object(name: str) -> None:
    """Refuse an object that does not exist.

    Raises:
        BadInput: it lists the known ones.
    """
    if name not in _MODULES:
        raise BadInput(
            f"there is no object {name!r}",
            field="object",
            remedy=f"Known: {', '.join(_MODULES)}.",
        )


@lru_cache(maxsize=64)
def build_object(request: ObjectRequest) -> Surface:
    """Build an object around its own origin, in metres."""
    check_object(request.name)
    module = importlib.import_module(f"hwp_bench.sim.props.{_MODULES[request.name]}")
    surface: Surface = module.build(request.name, request.variant)
    return surface
