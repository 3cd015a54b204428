"""Look ahead: whatever is wrong with a call is said before a suite is rendered for minutes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadMethod, HwpError, UsageError
from hwp_bench.base.files import Places, check_places, inside
from hwp_bench.base.folders import exclusive
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.evaluation.evaluate import EvaluationSettings, make_plan, with_setting_files
from hwp_bench.evaluation.results_folder import refuse_other
from hwp_bench.methods.contract import FRAME_CHOICES
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.methods.setting_files import check_settings
from hwp_bench.sim.produce.suites import SuiteItem, is_rendered, suite


def check_results_place(
    manifest: MethodManifest, out: Path, inputs: Mapping[str, Places], option: str = "--out"
) -> None:
    """Refuse results that would lie in the method or in data, or replace data.

    A method could read results in its own folder, and they would change its digest.

    Args:
        manifest: the method.
        out: the results folder.
        inputs: captures and other files that are read, by option.
        option: what names `out`, for messages.

    Raises:
        UsageError: the results folder is in the method's folder or in an input, or its folder
            `captures` holds an input.
    """
    check_places({option: out}, {"METHOD_DIR": manifest.root, **inputs})
    check_places({f"{option}, captures": out / "captures"}, inputs, replaces=True)


def check_call(
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    field: str = "settings",
    *,
    overwrite: bool = False,
) -> None:
    """Refuse a call that cannot work, as far as it can be told from the call alone.

    Args:
        manifest: the method.
        settings: settings, preset, training frames, exposed files.
        out: the results folder.
        field: where the settings come from, for messages.
        overwrite: results of another evaluation in `out` may be replaced.

    Raises:
        BadMethod: a setting or the preset has no such name.
        UsageError: a file that is named is not there, there is no such choice of frames, or `out`
            holds results of another evaluation.
        HwpError: the results folder is a file or lies in one.
    """
    check_settings(manifest, settings.run.settings, field)
    manifest.preset(settings.preset, settings.suite)
    if settings.run.frames not in FRAME_CHOICES and ":" not in settings.run.frames:
        known = ", ".join(FRAME_CHOICES)
        raise UsageError(f"{settings.run.frames!r} is not one of {known}", field="frames")
    for path in settings.confinement.exposed:
        if not path.exists():
            raise UsageError("does not exist", where=path, field="--expose")
    above = next((place for place in (out, *out.absolute().parents) if place.exists()), out)
    if above.exists() and not above.is_dir():
        raise HwpError(
            "cannot be a results folder, because a file is there",
            where=above,
            remedy="Choose another folder with --out.",
        )
    if not overwrite:
        plan = make_plan(manifest, (), with_setting_files(manifest, settings), {})
        refuse_other(out, plan.results([]))


def check_suite(
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    splits: Mapping[str, Split] | None = None,
    *,
    rehearse: bool = True,
) -> bool:
    """Refuse what would fail on a suite, before it is rendered.

    Args:
        manifest: the method; `check_call` has passed.
        settings: of the evaluation, with the name of the suite.
        out: the results folder.
        splits: splits by capture id; None applies the 80/10/10 rule.
        rehearse: make the method once with its settings where captures must be rendered first;
            not to be asked for where it runs on other machines.

    Returns:
        Whether the method was made once.

    Raises:
        BadSplit: a capture of the suite has no split, or one of another length.
        BadMethod: a submission has predictions of no capture of the suite.
        MethodFailed: the method cannot be made.
        HwpError: the results folder cannot be written, or another run is writing there.
    """
    items = suite(settings.suite)
    for item in items:
        split_for(item.scene.id, item.frame_count, splits)
    if manifest.kind == "predictions":
        _check_predictions(manifest, items)
    if is_rendered(settings.suite):
        return False
    with exclusive(out):
        pass
    if rehearse:
        make_plan(manifest, (), with_setting_files(manifest, settings), {}).rehearse()
    return rehearse


def _check_predictions(manifest: MethodManifest, items: Sequence[SuiteItem]) -> None:
    names = [item.scene.id for item in items]
    folders = {name: inside(manifest.root, f"{manifest.entry}/{name}") for name in names}
    missing = [name for name, folder in folders.items() if not any(folder.glob("*.png"))]
    if len(missing) == len(names):
        raise BadMethod(
            f"has predictions of no capture of this suite ({', '.join(names)})",
            where=manifest.root / str(manifest.entry),
            remedy=f"Put the frames into {manifest.entry}/CAPTURE/, or choose another suite.",
        )
    if missing:
        notice(f"no predictions of {', '.join(missing)}: every frame there gets the penalty")
