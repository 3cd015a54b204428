"""Data cards. Oracles: `mlcroissant`, the reader of its makers; the suites themselves."""

from __future__ import annotations

import json
import logging

import mlcroissant
import pytest

from hwp_bench.capture.splits import split_for
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.data_card import data_card
from hwp_bench.leaderboard.suite_data import known_data
from hwp_bench.suites.real import read_clips
from hwp_bench.suites.suite import suite
from hwp_bench.taxonomy import SUITES


@pytest.mark.parametrize("name", SUITES)
def test_a_card_is_croissant_and_lists_the_captures(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        dataset = mlcroissant.Dataset(jsonld=data_card(name))
    issues = dataset.metadata.ctx.issues
    assert list(issues.errors) == []
    # What is not known is not made up: nothing was published yet, at no address.
    assert all("is recommended" in text for text in issues.warnings), issues.warnings
    assert "not standard" not in caplog.text
    rows = list(dataset.records("captures"))
    found = {row["captures/id"]: row for row in rows}
    items = {item.id: item for item in suite(name)}
    assert found.keys() == items.keys()
    for identifier, item in items.items():
        row = found[identifier]
        assert row["captures/frames"] == item.frame_count
        assert row["captures/size"] == item.size
        assert row["captures/test"] == len(split_for(identifier, item.frame_count).test)
        parts = [row[f"captures/{part}"] for part in ("training", "validation", "test")]
        assert sum(parts) == item.frame_count


def test_digests_and_addresses_are_those_of_the_toolkit() -> None:
    rows = data_card("mini")["recordSet"][0]["data"]
    current = known_data().suites["mini"]
    for row in rows:
        version = current[row["captures/id"]].current
        assert version is not None
        assert row["captures/digest"] == version.digest
    files = {one["@id"]: one for one in data_card("real-1")["distribution"]}
    for clip in read_clips("real-1"):
        assert files[clip.id]["contentUrl"].endswith(f"{clip.commit}/{clip.path}")
        assert files[clip.id]["sha256"] == clip.sha256


def test_the_reader_refuses_a_wrong_card() -> None:
    card = data_card("smoke")
    card["recordSet"][0]["field"][0]["dataType"] = "sc:Nothing"
    with pytest.raises(mlcroissant.ValidationError):
        mlcroissant.Dataset(jsonld=card).metadata.record_sets[0].fields[0].data_type  # noqa: B018


def test_the_command_prints_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dev", "card", "smoke"]) == 0
    assert json.loads(capsys.readouterr().out) == data_card("smoke")
    with pytest.raises(SystemExit):
        main(["dev", "card", "nothing"])
