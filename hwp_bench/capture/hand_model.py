"""Load the hand template that parameters belong to, and refuse every other."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.template_sources import load_template

if TYPE_CHECKING:
    from hwp_bench.capture.schema import HandModelId
    from hwp_bench.hands.template import HandTemplate


def load_matching_template(
    model: HandModelId, sides: Sequence[str], side: str, *, where: str | os.PathLike[str]
) -> HandTemplate:
    """Load the template of one side of the model that parameters were made with.

    Args:
        model: what the capture (or avatar) says of its hand model; the digest is that of the
            first of its sides.
        sides: the hands that it has, in its order.
        side: the hand that is wanted.
        where: the capture or avatar, for the message.

    Raises:
        BadInput: the model that is installed here is another one: by name or by content.
        UsageError, BadHandModel: it cannot be loaded.
    """
    first = load_template(model.source, sides[0])
    problem = None
    if first.name != model.name:
        problem = f"belongs to hand model {model.name}, not {first.name}"
    elif first.digest != model.digest:
        problem = (
            f"belongs to another edition of hand model {model.name} "
            f"({model.digest[:12]}) than the one here ({first.digest[:12]})"
        )
    if problem is not None:
        raise BadInput(
            problem,
            where=where,
            field="hand_model",
            remedy=f"Use the model that it was made with, or convert it: hwp-bench hands convert "
            f"(what is loaded here comes from {model.source!r}).",
        )
    return first if side == sides[0] else load_template(model.source, side)
