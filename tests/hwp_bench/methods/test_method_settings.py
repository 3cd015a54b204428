"""Settings in tables and tables of tables; the oracle is the dataclass built by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from textwrap import dedent
from typing import Literal

import pytest

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.methods.settings import choice, class_settings, number, settings_from


@dataclass(frozen=True)
class Inner:
    width: int = number(4, 1, 10)
    kind: str = choice("one", "two")
    shape: Literal["round", "flat"] = "round"

    def __post_init__(self) -> None:
        if self.width == 7:
            raise UsageError("is 7", field="width")


@dataclass(frozen=True)
class Outer:
    rate: float = 0.5
    on: bool = True
    limit: float | None = None
    inner: Inner = field(default_factory=Inner)


def test_tables_and_dotted_names_mean_the_same() -> None:
    expected = Outer(rate=1.0, on=False, limit=3.0, inner=Inner(2, "two"))
    tables = {"rate": 1, "on": False, "limit": 3, "inner": {"width": 2, "kind": "two"}}
    assert settings_from(Outer, tables, "here") == expected
    flat = {"rate": 1, "on": False, "limit": 3, "inner.width": 2, "inner.kind": "two"}
    assert settings_from(Outer, flat, "here") == expected


def test_what_comes_later_wins() -> None:
    values = {"inner": {"width": 2, "kind": "two"}, "inner.width": 5}
    assert settings_from(Outer, values, "here").inner == Inner(5, "two")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": 3}, "inner: must be a table"),
        ({"inner.widht": 3}, r"inner\.widht: is not known\. Did you mean 'inner\.width'"),
        ({"inner": {"width": 11}}, r"inner\.width: is 11, expected an integer from 1 to 10"),
        ({"inner": {"width": 7}}, r"inner\.width: is 7"),
        ({"inner.kind": "three"}, "one, two"),
        ({"inner.shape": "oval"}, r"inner\.shape: is 'oval'.*round, flat"),
        ({"on": 1}, "on: .*true or false"),
        ({"limit": "none"}, "limit: is 'none', expected a finite number at least 0"),
        ({"rate": {"a": 1}}, "rate"),
    ],
)
def test_mistakes_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(BadMethod, match=message):
        settings_from(Outer, values, "here")


def _sources(folder: Path, **texts: str) -> Path:
    for name, text in texts.items():
        place = folder / f"{name.replace('__', '/')}.py"
        place.parent.mkdir(exist_ok=True)
        place.write_text("from dataclasses import dataclass\n" + dedent(text))
    return folder


def test_names_come_from_the_dataclass_without_running_it(tmp_path: Path) -> None:
    root = _sources(
        tmp_path,
        mine="""
            import other as elsewhere
            from inner.parts import Table as Rows
            from typing import Annotated, ClassVar
            raise SystemExit("this source must not run")

            @dataclass
            class Base:
                steps: int = 3
                table: int = 1
                kept: "Rows | None" = None

            @dataclass(frozen=True)
            class Mine(Base):
                LIMIT: ClassVar[int] = 3
                table: Annotated[Rows, "a table"] = None
                far: elsewhere.Far = None
                free: dict[str, int] = None
                unknown: missing.Type = None
                plain = 5

                def method(self) -> None:
                    local: int = 3
            """,
        inner__parts="""
            @dataclass(frozen=True)
            class Table:
                width: int = 1
            """,
        other="""
            import dataclasses
            @dataclasses.dataclass
            class Far:
                deep: "Deep" = None
            @dataclasses.dataclass
            class Deep:
                x: float = 0.0
            """,
    )
    names = class_settings(root, "mine:Mine")
    assert names == ["steps", "kept.width", "table.width", "far.deep.x", "free", "unknown"]


def test_the_toolkits_own_classes_are_found_and_the_methods_come_first(tmp_path: Path) -> None:
    reference = "wildghand.model.settings:WildGHandSettings"
    assert "schedule.epochs" in class_settings(tmp_path, reference)
    text = "@dataclass\nclass WildGHandSettings:\n    own: int = 1\n"
    (tmp_path / "wildghand").mkdir()
    assert class_settings(
        _sources(tmp_path, wildghand__model=text), "wildghand.model:WildGHandSettings"
    ) == ["own"]


@pytest.mark.parametrize(
    ("reference", "text", "message"),
    [
        ("mine:Other", "@dataclass\nclass Mine:\n    a: int", "'mine:Other' is not there"),
        ("his:Mine", "", "'his:Mine' is not there"),
        ("mine:Mine", "class Mine:\n    a: int", "is not a dataclass"),
        ("mine:Mine", "class Mine(", "mine.py cannot be parsed"),
        ("mine:Mine", "@dataclass\nclass Mine:\n    a: Mine", "'mine:Mine' is a table of itself"),
        ("mine:Mine", "from mine import Mine", "'mine:Mine' is not there"),
    ],
)
def test_a_class_that_cannot_be_read_is_said(
    tmp_path: Path, reference: str, text: str, message: str
) -> None:
    with pytest.raises(BadMethod, match=message):
        class_settings(_sources(tmp_path, mine=text), reference)
