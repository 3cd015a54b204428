"""Settings: modes, dotted names. Oracles: the defaults, the paper."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.records import flattened
from hwp_bench.methods.manifest import find_method, read_manifest
from wildghand.model.settings import (
    MODES,
    NetworkChoice,
    ScheduleSettings,
    WildGHandSettings,
    read_settings,
)
from wildghand.model.terms import WEIGHTS, TermSettings
from wildghand.network import network_settings
from wildghand.pao.pao import PerturbationAwareWeights

#: Every setting by its dotted name, with its default.
EVERY = dict(flattened(dataclasses.asdict(WildGHandSettings())))


def value_of(settings: WildGHandSettings, name: str) -> Any:
    value: Any = settings
    for part in name.split("."):
        value = getattr(value, part)
    return value


def test_the_defaults_are_those_of_the_default_mode() -> None:
    assert read_settings({}) == read_settings({"mode": "default"}) == WildGHandSettings()


@pytest.mark.parametrize("name", EVERY)
def test_a_dotted_name_reaches_every_setting(name: str) -> None:
    default = EVERY[name]
    other: Any = default
    if isinstance(default, bool):
        other = not default
    elif isinstance(default, float):
        other = default / 2.0
    made = read_settings({name: other})
    assert value_of(made, name) == other
    *tables, field = name.split(".")
    nested: dict[str, Any] = {field: other}
    for table in reversed(tables):
        nested = {table: nested}
    assert read_settings(nested) == made
    # What a setting changes besides itself: parts of a component that it takes out.
    changed = {n for n in EVERY if value_of(made, n) != EVERY[n]} - {name}
    idle = {
        "dpd.enabled": {"dpd.additions"},
        "prepass.enabled": {"prepass.frame_poses"},
    }
    assert changed == idle.get(name, set())


def test_stored_settings_are_read_as_they_were() -> None:
    for changes in ({}, {"mode": "paper"}, {"network.size": "paper"}, {"dpd.enabled": False}):
        made = read_settings(changes)
        assert read_settings(dataclasses.asdict(made)) == made


@pytest.mark.parametrize(
    ("mode", "variant", "batch", "by_time"),
    [("paper", "printed", 4, False), ("released", "released", 0, True)],
)
def test_the_published_modes_have_no_addition(
    mode: str, variant: str, batch: int, by_time: bool
) -> None:
    made = read_settings({"mode": mode})
    assert made.terms.fixed == WEIGHTS[mode]
    assert (made.terms.dssim_weight, made.terms.surface) == (0.0, 0.0)
    assert (made.terms.outside_weight, made.terms.perceptual) == (1.0, 0.1)
    assert (made.pao.variant, made.dpd.poses) == (variant, by_time)
    starts = [PerturbationAwareWeights(variant, hands) for hands in (1, 2)]
    assert [start.T_b.item() for start in starts] == [3.0, 10.0]
    assert (starts[0].T_E.item(), starts[0].T_mu.item()) == (1.0, pytest.approx(0.3))
    schedule = made.schedule
    assert (schedule.batch, schedule.rates, schedule.epochs) == (batch, mode, 50)
    assert (schedule.frames_per_second, schedule.average_share) == (0.0, 0.0)
    assert not made.prepass.enabled
    assert not made.subject.enabled
    assert not made.light.enabled
    assert not made.dpd.additions
    assert not made.prepass.frame_poses
    assert made.dpd.enabled
    assert made.pao.enabled
    assert made.heads
    differing = {name for name in EVERY if value_of(made, name) != EVERY[name]}
    assert differing <= {name for name, _ in flattened(MODES[mode])} | {"prepass.frame_poses"}


def test_a_setting_that_is_given_wins_over_the_modes() -> None:
    for values in (
        {"dpd.additions": True, "mode": "paper", "terms.surface": 0.5},
        {"mode": "paper", "dpd": {"additions": True}, "terms": {"surface": 0.5}},
    ):
        made = read_settings(values)
        assert made.dpd.additions
        assert (made.terms.surface, made.terms.weights) == (0.5, "paper")
    assert read_settings({"mode": "paper", "prior": "/some/prior"}).prior == "/some/prior"


def test_a_table_in_part_leaves_the_rest_of_it() -> None:
    made = read_settings({"prepass": {"weight_floor": 0.5}, "prepass.tolerance": 2})
    assert (made.prepass.weight_floor, made.prepass.tolerance) == (0.5, 2.0)
    assert made.prepass.enabled
    assert made.prepass.frame_poses


def test_the_prepass_is_a_component_of_its_own() -> None:
    made = read_settings({"dpd.enabled": False, "pao.enabled": False})
    assert made.prepass.enabled
    assert made.prepass.frame_poses
    assert not read_settings({"prepass.enabled": False}).prepass.frame_poses


def test_without_heads_the_rest_stays() -> None:
    made = read_settings({"heads": False})
    assert made == dataclasses.replace(read_settings({}), heads=False)


@pytest.mark.parametrize(
    ("values", "name", "idle"),
    [
        ({"mode": "released", "heads": False}, "dpd.poses", False),
        ({"pao.variant": "binary", "pao.regions": "sam:/x"}, "pao.regions", "superpixels"),
    ],
    ids=str,
)
def test_what_has_no_effect_is_off(values: dict[str, Any], name: str, idle: object) -> None:
    assert value_of(read_settings(values), name) == idle


def test_the_size_chooses_the_network() -> None:
    made = read_settings({"network": {"size": "paper"}, "network.plane_resolution": 64})
    assert made.network.build() == network_settings("paper", plane_resolution=64)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"varint": True}, r"varint: is not a setting.*Did you mean 'pao\.variant'\?"),
        ({"dpd.aditions": 1}, r"dpd\.aditions.*Did you mean 'dpd\.additions'\?"),
        ({"dpd": {"aditions": 1}}, r"dpd\.aditions.*Did you mean 'dpd\.additions'\?"),
        ({"network.sizes": "paper"}, r"network\.sizes.*Did you mean 'network\.size'\?"),
        ({"moed": "paper"}, "moed.*Did you mean 'mode'"),
        ({"dpd.zzz": 4}, r"dpd\.zzz: is not a setting.*Known: dpd\.enabled"),
        ({"zzz": 4}, "zzz: is not a setting.*Known: mode, prior"),
        ({"mode": "papr"}, "mode: is 'papr'.*default, paper, released, bare"),
        ({"mode": 3}, "mode: is '3'"),
        ({"schedule": 3}, "schedule: must be a table"),
        ({"dpd": 1}, "dpd: must be a table"),
        ({"prior.name": "x"}, r"prior\.name: is not a setting"),
        ({"prepass.weight_floor": 1.5}, r"prepass\.weight_floor: is 1\.5"),
        ({"pao.variant": "masks"}, r"pao\.variant: is 'masks'"),
        ({"schedule.epochs": -1}, r"schedule\.epochs: is -1"),
        ({"schedule.rates": "slow"}, r"schedule\.rates: is 'slow'"),
        ({"terms.surface": -1}, r"terms\.surface: is -1"),
        ({"network.plane_resolution": 42}, "plane_resolution: is 42"),
        ({"binary_mask": 1}, "binary_mask: is not a setting"),
    ],
    ids=str,
)
def test_what_is_wrong_is_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BadMethod, match=message) as caught:
        read_settings(values)
    assert "\n" not in str(caught.value)


def test_the_mode_of_the_bare_network_is_all_that_network_scratch_changes() -> None:
    made = read_settings({"mode": "bare"})
    off = {name for name in EVERY if value_of(made, name) != EVERY[name]}
    idle = {"prepass.frame_poses", "dpd.additions"}
    assert off - idle == {name for name, _ in flattened(MODES["bare"])}
    # Every baseline has the choice of an earlier state and this share of D-SSIM; the resolution is
    # the best of its trials.
    assert read_manifest(find_method("baselines/network-scratch")).presets["default"] == {
        "mode": "bare",
        "schedule": {"validated": True},
        "network": {"identity_resolution": 80},
        "terms": {"dssim_weight": 0.05},
    }


def test_settings_are_few_and_each_number_has_a_range() -> None:
    for table in (NetworkChoice, ScheduleSettings, TermSettings, WildGHandSettings):
        for item in dataclasses.fields(table):
            if item.type in ("int", "float"):
                assert "range" in item.metadata, item.name
    ours = [n for n in EVERY if n.partition(".")[0] in ("network", "schedule", "terms")]
    assert len(ours) == 20
    assert len(EVERY) <= 60
    assert len([name for name in EVERY if "." not in name]) <= 8


@pytest.mark.parametrize("name", ["wildghand", "network-scratch"])
def test_the_manifest_lists_every_setting(name: str) -> None:
    assert list(read_manifest(find_method(name)).settings) == ["mode", *EVERY]


def test_hidden_skin_is_off_where_released_weights_overrule_it() -> None:
    assert not read_settings({"pao.variant": "released"}).terms.leave_hidden
    assert read_settings({"pao.variant": "released", "pao.enabled": False}).terms.leave_hidden
    assert read_settings({}).terms.leave_hidden
