"""The shape of a person's hand: what the rest surface and joints of a template lack."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.hands import HandTemplate

# Names under which an avatar keeps a shape.
_PREFIX = "subject_"
# Largest displacement that is read, m.
_LARGEST = 0.1


@dataclass(frozen=True, eq=False)
class SubjectShape:
    """How a person's hand differs from the template; of the right hand, the left is its mirror."""

    #: (V, 3) m, added to the rest vertices.
    vertices: np.ndarray
    #: (16, 3) m, added to the rest joints.
    joints: np.ndarray

    def to_tensors(self) -> dict[str, torch.Tensor]:
        """The fields as float32 tensors, by the names under which an avatar keeps them."""
        return {
            f"{_PREFIX}{item.name}": torch.as_tensor(getattr(self, item.name), dtype=torch.float32)
            for item in fields(self)
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, torch.Tensor], template: HandTemplate, where: str
    ) -> SubjectShape | None:
        """Read what `to_tensors` made.

        Args:
            tensors: of an avatar.
            template: of its hand model, of either side.
            where: the file, for messages.

        Returns:
            The shape; None where the avatar keeps none.

        Raises:
            BadInput: it is one of another template, or larger than any hand.
        """
        if f"{_PREFIX}vertices" not in tensors:
            return None
        found = {}
        for name, like in (("vertices", template.vertices), ("joints", template.joints)):
            tensor = tensors.get(f"{_PREFIX}{name}")
            if tensor is None or tuple(tensor.shape) != like.shape:
                raise BadInput(f"has no shape {like.shape}", where=where, field=f"{_PREFIX}{name}")
            if not bool((tensor.abs() <= _LARGEST).all()):
                raise BadInput(
                    f"moves the hand by more than {_LARGEST} m, or by no number",
                    where=where,
                    field=f"{_PREFIX}{name}",
                )
            found[name] = tensor.double().cpu().numpy()
        return cls(**found)

    def applied(self, template: HandTemplate) -> HandTemplate:
        """The person's hand of the template's side; its parameters mean the same."""
        flip = side_flip(template.side)
        return replace(
            template,
            vertices=template.vertices + self.vertices * flip,
            joints=template.joints + self.joints * flip,
        )


def side_flip(side: str) -> np.ndarray:
    """(3,) factors from the right hand's rest frame to that of a side."""
    return np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
