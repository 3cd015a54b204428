"""Method directories: finding them, reading and checking `method.toml`, and settings against it."""

from __future__ import annotations

import importlib.util
import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, BadMethod, UsageError, nearest
from hwp_bench.base.files import inside
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.base.records import (
    Line,
    check_json_values,
    flattened,
    parse_record,
    parse_toml,
    without_schema,
)
from hwp_bench.methods.contents import digest_of, method_files
from hwp_bench.methods.settings import class_settings
from hwp_bench.results import TrainingData
from hwp_bench.taxonomy import SIZED_LIKE

#: Version of the method contract.
SCHEMA = "hwp-method/1"
#: Name of the file that makes a folder a method directory.
MANIFEST = "method.toml"
#: Group of entry points in which an installed package names the packages of its methods.
ENTRY_POINTS = "hwp_bench.methods"
#: Largest `method.toml`, in bytes.
MAX_BYTES = 64 * 1024
#: Preset that is used when none is asked for.
DEFAULT_PRESET = "default"


def _matching(pattern: str, description: str) -> Meta:
    return Meta(pattern=rf"\A(?:{pattern})\Z", description=description)


#: Pattern of a method's name.
METHOD_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
_MethodName = Annotated[str, _matching(METHOD_NAME, "a name of letters, digits and . _ -")]
_PythonEntry = Annotated[str, _matching(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", "module:callable")]
_Words = Annotated[list[str], Meta(min_length=1, description="a list of words")]
_SwitchName = Annotated[
    str, _matching(r"[a-z0-9][a-z0-9-]{0,31}", "a name of lower-case letters, digits and hyphens")
]
_SettingName = Annotated[
    str, _matching(r"[A-Za-z_]\w{0,63}(\.[A-Za-z_]\w{0,63}){0,7}", "a name of a setting")
]
_SettingsItem = Annotated[
    str,
    _matching(
        r"[A-Za-z_]\w{0,63}(\.[A-Za-z_]\w{0,63}){0,7}(:[A-Za-z_]\w{0,63})?",
        "a name of a setting, or module:Class",
    ),
]
_KindName = Annotated[str, _matching(r"[a-z][a-z0-9-]{0,31}", "a word of letters and digits")]
#: What a method may choose by validation frames; it learns from training frames alone.
VALIDATION_USES: Mapping[str, str] = {
    "earlier-state": "the fit ends with an earlier state where that draws them better",
    "settings": "single settings are chosen for the capture",
    "shape": "how far the hand's shape is fitted is chosen",
    "clean-frames": "training frames are judged by how these, which are clean, look",
}
_ValidationUse = Annotated[
    str, _matching("|".join(VALIDATION_USES), f"one of {', '.join(VALIDATION_USES)}")
]
_SwitchSettings = Annotated[
    dict[_SettingName, Any], Meta(min_length=1, description="a table of at least one setting")
]


@dataclass(frozen=True)
class EntryPoint:
    """How a method is entered, in one of three ways."""

    #: `module:callable`.
    python: _PythonEntry | None = None
    #: The words of a command.
    command: _Words | None = None
    #: The folder of predictions.
    predictions: str | None = None

    def __post_init__(self) -> None:
        if sum(value is not None for value in vars(self).values()) != 1:
            raise UsageError(f"must have exactly one of {', '.join(vars(self))}")


@dataclass(frozen=True)
class Switch:
    """One component of a method that can be taken out, or one alternative to how it works."""

    #: Short name: lower-case letters, digits, `-`; the file has it as the name of the table.
    name: str
    #: Name in tables; its short name where the file does not say.
    title: Line = ""
    description: Line = ""
    #: Settings that override the preset in its variant: those that take a component out, or those
    #: that put an alternative in the place of what the method does otherwise.
    settings_off: _SwitchSettings | None = None
    settings_on: _SwitchSettings | None = None

    def __post_init__(self) -> None:
        if (self.settings_off is None) == (self.settings_on is None):
            raise UsageError(
                "must have exactly one of settings_off and settings_on",
                remedy="settings_off takes a component out; settings_on puts an alternative in.",
            )
        object.__setattr__(self, "title", self.title or self.name)

    @property
    def alternative(self) -> bool:
        """Whether it puts an alternative in; else it takes a component out."""
        return self.settings_on is not None

    @property
    def settings(self) -> Mapping[str, Any]:
        """Settings that override the preset in its variant."""
        return self.settings_on or self.settings_off or {}

    @property
    def variant_name(self) -> str:
        """Name of the variant that this switch makes: `no-dpd`, `binary-mask`."""
        return self.name if self.alternative else f"no-{self.name}"


@dataclass(frozen=True)
class Base:
    """A simpler form of a method that ablations may start from, such as that of its paper."""

    #: Short name, as a switch's; the file has it as the name of the table.
    name: str
    #: Settings that make it, in every variant.
    settings: _SwitchSettings
    #: Names of the components that are crossed when nothing is asked for.
    crossed: Annotated[list[_SwitchName], Meta(min_length=1, max_length=4)]
    description: Line = ""
    #: Names of the other components that are in it; those not named are out of every variant.
    kept: list[_SwitchName] = field(default_factory=list)


@dataclass(frozen=True)
class ManifestFields:
    """The fields of a `method.toml` except its schema; empty ones are absent from the file."""

    #: Short name: letters, digits, `.`, `_`, `-`.
    name: _MethodName
    entry: EntryPoint
    #: What it was trained on before it sees a capture; `"none"` in the file where that is nothing.
    training: TrainingData
    #: Name in tables; the short name where the file does not say.
    title: Line = ""
    description: Line = ""
    #: Who made it, its terms of use, its page.
    authors: Line = ""
    licence: Line = ""
    url: Line = ""
    #: What it uses validation frames for, at most: words of `VALIDATION_USES`, empty for nothing;
    #: None where the file does not say.
    validation: Annotated[list[_ValidationUse], Meta(max_length=10)] | None = None
    #: Names of its settings, dotted within tables. A name stands for everything below it, and
    #: `module:Class` for the fields of a dataclass.
    settings: list[_SettingsItem] = field(default_factory=list)
    #: Settings whose value may be `KIND:PATH`, a file or folder of a person's: the kinds, by name.
    #: What a person sets this way needs no `--expose`. A preset exposes nothing: it comes with
    #: the method.
    files: dict[_SettingName, list[_KindName]] = field(default_factory=dict)
    #: Settings by preset.
    presets: dict[str, dict[str, Any]] = field(default_factory=dict)
    #: Components and alternatives for ablations, by name, in the order of the file.
    switches: dict[_SwitchName, Switch] = field(default_factory=dict)
    #: Names of the components that an ablation crosses when nothing is asked for.
    crossed: Annotated[list[_SwitchName], Meta(max_length=4)] = field(default_factory=list)
    #: What else an ablation may start from (`--base`), by name.
    bases: dict[_SwitchName, Base] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class MethodManifest(ManifestFields):
    """A checked `method.toml`; all its `settings` are names."""

    root: Path

    @property
    def kind(self) -> str:
        """`python`, `command` or `predictions`."""
        return next(kind for kind, value in vars(self.entry).items() if value is not None)

    def check_setting_names(self, values: Mapping[str, Any], field: str = "settings") -> None:
        """Refuse a setting that the method does not have, before anything runs.

        Methods that do not list their settings take any; the values are the method's to check.
        `a.b` and tables within tables are the same. `field` says where the settings come from.
        """
        known, tables = set(self.settings), {name.rpartition(".")[0] for name in self.settings}
        for name, _ in flattened(values) if self.settings else ():
            above = itertools.accumulate(name.split("."), "{}.{}".format)
            if name not in tables and known.isdisjoint(above):
                problem = f"{name[:100]!r} is not a setting of {self.name}"
                raise self._wrong(problem, field, self._nearest_settings(name))

    def doubt_setting_names(self, values: Mapping[str, Any], field: str = "settings") -> None:
        """Refuse a name that is nearly one of the presets', where the method lists no settings.

        Such a method takes any name, so that a mistyped one would run without an effect. A name
        that resembles none is let through, and said.
        """
        tables = [*self.presets.values(), *(switch.settings for switch in self.switches.values())]
        known = {name for table in tables for name, _ in flattened(table)}
        unknown = [name for name, _ in flattened(values) if name not in known]
        for name in unknown if not self.settings else ():
            close = nearest(name, sorted(known), most=3, cutoff=0.75)
            if close:
                problem = f"{name[:100]!r} is in no preset or switch of {self.name}"
                remedy = f"Did you mean {' or '.join(map(repr, close))}? If it is a setting, list "
                raise self._wrong(problem, field, remedy + "the names of all under `settings`.")
            notice(f"{field}: {name}: {self.name} does not list its settings; not checked")

    def _wrong(self, problem: str, field: str, remedy: str) -> BadMethod:
        return BadMethod(problem, where=self.root / MANIFEST, field=field, remedy=remedy)

    def _nearest_settings(self, wrong: str) -> str:
        """Say which setting was probably meant, or which there are in its place."""
        last = {name.rpartition(".")[2]: name for name in self.settings}
        close = nearest(wrong, self.settings, cutoff=0.75)
        close = close or [last[word] for word in nearest(wrong, last)]
        if close:
            return f"Did you mean {close[0]!r}?"
        table = wrong.rpartition(".")[0]
        known = [name for name in self.settings if name.rpartition(".")[0] == table]
        if not table or not known:
            known = list(dict.fromkeys(name.partition(".")[0] for name in self.settings))
        return f"Known: {', '.join(known)}."

    def preset(self, name: str | None, suite: str = "") -> str:
        """Return the name of the preset to use.

        None takes the one named like the suite where the method has it, else that of a suite of
        the same size, else `default`.
        """
        if name is None:
            fitting = (suite, SIZED_LIKE.get(suite, ""))
            return next((name for name in fitting if name in self.presets), DEFAULT_PRESET)
        if name not in self.presets and name != DEFAULT_PRESET:
            known = ", ".join(self.presets) or DEFAULT_PRESET
            raise self._wrong(f"has no preset {name!r}", "presets", f"It has: {known}.")
        return name

    @property
    def contents(self) -> dict[str, str]:
        """SHA-256 (hex) by name of every file of the method: what is run.

        Baselines that ship are built on `wildghand`, whose files count as theirs.
        """
        own, base = method_files(self.root), PACKAGES / "wildghand"
        if not ships(self.root) or self.root.resolve() == base:
            return own
        return own | {f"../wildghand/{name}": one for name, one in method_files(base).items()}

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of `contents`."""
        return digest_of(self.contents)


def find_method(text: str) -> Path:
    """Find a method directory by path, or by the name of one that ships or is installed.

    Args:
        text: a path such as `my_method/`; `plain`, `baselines/plain`, `wildghand`; or the name of
            an entry point `hwp_bench.methods`.

    Raises:
        BadMethod: there is no such directory.
    """
    if (Path(text) / MANIFEST).is_file():
        return Path(text)
    name = Path(text).as_posix().removeprefix("baselines/")
    for folder in _shipped_folders():
        if folder.name == name:
            return folder
    if installed := _installed_folders().get(text):
        return installed
    raise BadMethod(
        f"is not a method directory: it has no {MANIFEST}",
        where=text,
        remedy="`hwp-bench list methods` shows the ones that ship or are installed.",
    )


def shipped_methods() -> list[MethodManifest]:
    """Return the methods that ship with the toolkit: the reference method and the baselines."""
    return [read_manifest(folder) for folder in _shipped_folders()]


def installed_methods() -> list[MethodManifest]:
    """Return the methods of installed packages; a faulty one is left out, and said."""
    found = []
    for name, folder in _installed_folders().items():
        try:
            found.append(replace(read_manifest(folder), name=name))
        except BadInput as error:
            notice(f"left out: {error}")
    return found


def _installed_folders() -> dict[str, Path]:
    """Folders of the packages that entry points name; nothing of them is imported."""
    found, shipped = {}, {folder.name for folder in _shipped_folders()}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        top, *below = point.module.split(".")
        spec = importlib.util.find_spec(top)
        if spec and spec.submodule_search_locations and point.name not in shipped:
            found[point.name] = Path(spec.submodule_search_locations[0], *below)
    return found


def _shipped_folders() -> list[Path]:
    folders = [PACKAGES / "wildghand", *sorted(data_folder("baselines").iterdir())]
    return [folder for folder in folders if (folder / MANIFEST).is_file()]


def read_manifest(path: str | os.PathLike[str]) -> MethodManifest:
    """Read and check the `method.toml` of a method directory.

    Raises:
        BadMethod: it is missing, too large or not TOML, or a field is unknown, missing or wrong.
    """
    root = Path(path)
    where = root / MANIFEST
    if not where.is_file():
        raise BadMethod(f"is not a method directory: it has no {MANIFEST}", where=root)
    if where.stat().st_size > MAX_BYTES:
        raise BadMethod(f"is larger than {MAX_BYTES} bytes", where=where)
    try:
        text = where.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadMethod(f"is not valid TOML ({error})", where=where) from error
    except OSError as error:
        raise BadMethod(f"cannot be read ({error.strerror})", where=where) from error
    value = parse_toml(text, where=where, error=BadMethod)
    fields = without_schema(value, SCHEMA, where=where, error=BadMethod)
    authors = fields.get("authors")
    if isinstance(authors, list) and all(isinstance(name, str) for name in authors):
        fields["authors"] = ", ".join(authors)
    if isinstance(fields.get("settings"), str):
        fields["settings"] = [fields["settings"]]
    fields["training"] = _training(fields.get("training", ""), where)
    for kind in ("switches", "bases"):
        found = fields.get(kind)
        if isinstance(found, dict) and all(isinstance(item, dict) for item in found.values()):
            fields[kind] = {name: {**item, "name": name} for name, item in found.items()}
    table = parse_record(ManifestFields, fields, where=where, error=BadMethod)
    names: list[str] = []
    for item in table.settings:
        names += class_settings(root, item) if ":" in item else [item]
    known = {**vars(table), "settings": names, "title": table.title or table.name}
    manifest = MethodManifest(**known, root=root)
    if table.entry.predictions is not None:
        inside(root, table.entry.predictions)
    manifest.check_setting_names(manifest.files, "files")
    tables: dict[str, Mapping[str, Any]] = {
        f"presets.{name}": preset for name, preset in manifest.presets.items()
    }
    for name, switch in manifest.switches.items():
        kind = "settings_on" if switch.alternative else "settings_off"
        tables[f"switches.{name}.{kind}"] = switch.settings
    tables |= {f"bases.{name}.settings": base.settings for name, base in manifest.bases.items()}
    for place, values in tables.items():
        check_json_values(values, where=where, field=place, error=BadMethod)
        manifest.check_setting_names(values, place)
    _check_switches(manifest, where)
    return manifest


def _training(value: Any, where: Path) -> Any:
    """Return the table of training data, empty for the word "none"."""
    if value in ({}, "") or (isinstance(value, str) and value != "none"):
        raise BadMethod(
            "does not say what the method was trained on before it sees a capture",
            where=where,
            field="training",
            remedy='Write `training = "none"` where that is nothing, else a table [training] with '
            "`simulated`, `public` or `private` (docs/methods.md).",
        )
    return {} if value == "none" else value


def _check_switches(manifest: MethodManifest, where: Path) -> None:
    """Refuse variants of one name; where components are named, any other name, and one twice."""
    variants = [switch.variant_name for switch in manifest.switches.values()]
    for name in variants:
        if variants.count(name) > 1:
            raise BadMethod(f"two switches make a variant {name!r}", where=where, field="switches")
    components = [item.name for item in manifest.switches.values() if not item.alternative]
    lists = {"crossed": manifest.crossed}
    for base in manifest.bases.values():
        lists[f"bases.{base.name}"] = [*base.crossed, *base.kept]
    for place, names in lists.items():
        for name in names:
            if name not in components or names.count(name) > 1:
                twice = "there twice" if name in components else "not a component"
                raise BadMethod(
                    f"{name!r} is {twice}",
                    where=where,
                    field=place,
                    remedy=f"Name each of these at most once: {', '.join(components) or 'none'}.",
                )


def find_setting_files(
    manifest: MethodManifest, values: Mapping[str, Any]
) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """Make the paths in a person's settings absolute, since a method runs in another folder."""
    found: dict[Path, None] = {}

    def resolve(value: Any, name: str) -> Any:
        if isinstance(value, Mapping):
            return {
                key: resolve(item, f"{name}.{key}" if name else key) for key, item in value.items()
            }
        kind, colon, place = value.partition(":") if isinstance(value, str) else ("", "", "")
        if not colon or kind not in manifest.files.get(name, []):
            return value
        path = Path(os.path.abspath(Path(place).expanduser()))
        if not place or not path.exists():
            raise UsageError(
                "does not exist" if place else "names no file",
                where=path if place else None,
                field=name,
                remedy=f"Give {kind}:PATH with a file or folder of yours; nothing is downloaded.",
            )
        found[path] = None
        return f"{kind}:{path}"

    resolved: dict[str, Any] = resolve(values, "")
    return resolved, tuple(found)


def check_settings(
    manifest: MethodManifest, values: Mapping[str, Any], field: str = "settings"
) -> None:
    """Refuse settings that cannot work, before anything is rendered or run.

    Names are checked, and files that settings name must be there. What is in them is the method's
    own to check where it is made: its code runs in the sandbox only.
    """
    manifest.check_setting_names(values, field)
    manifest.doubt_setting_names(values, field)
    find_setting_files(manifest, values)


def ships(root: Path) -> bool:
    """Return whether a method directory is one that ships with the toolkit."""
    places = (PACKAGES / "wildghand", data_folder("baselines"))
    return any(root.resolve().is_relative_to(place.resolve()) for place in places)
