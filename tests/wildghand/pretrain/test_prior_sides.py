"""The shipped prior and the hands of a capture. Oracle: the digests of the templates themselves."""

from __future__ import annotations

import pytest

from hwp_bench.capture.schema import HandModelId
from hwp_bench.hands import load_template
from wildghand.model.settings import read_settings
from wildghand.prior.prior import choose_prior


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_capture_of_either_hand_alone_starts_from_the_shipped_prior(side: str) -> None:
    """A capture states the digest of its first hand, and the left hand has another one."""
    template = load_template("anny", side)
    settings = read_settings({})
    assert choose_prior(settings, HandModelId(template.name, template.digest)) is not None


@pytest.mark.parametrize("source", ["anny", "mano:/nowhere"])
def test_another_edition_starts_without_it(source: str) -> None:
    name = load_template("anny", "right").name
    assert choose_prior(read_settings({}), HandModelId(name, "0" * 64, source)) is None
