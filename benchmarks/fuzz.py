"""Bad input for every command: files, settings and names that strangers write.

Run from the repository: `python -m benchmarks.fuzz --minutes 10 [--seed 1] [--only table verify]`.
Small valid inputs of every kind are made first (a minute). Each case changes one or two of them,
or a word of a command line, and runs one command in a forked process, with 20 s of processor time
and 2 GiB of memory of its own. Every command must end with status 0, 1 or 2, in at most one
message, without a traceback, without characters that steer a terminal, and without leaving a part
of an output. What does not is kept in the folder of `--keep`, with the words that show it again.
Exit status 1 where something was found.
"""

from __future__ import annotations

import argparse
import collections
import gc
import importlib
import os
import random
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz_mutations import NAMES, WORDS, mutate
from benchmarks.fuzz_seeds import FIT, make_seeds
from benchmarks.fuzz_worker import faults_of, run_forked

#: Output of a command, in its words.
OUT = "@out"


@dataclass(frozen=True)
class Target:
    """One command and the inputs that it reads."""

    #: Words of the command line; the first is the program.
    words: tuple[str, ...]
    #: Patterns below the folder of seeds: files that are changed.
    files: tuple[str, ...] = ()
    #: Options whose values are changed too: `--set`, or a number.
    options: tuple[str, ...] = ()
    #: How often it has its turn, next to others.
    weight: float = 1.0
    #: Whether its output is there whole or not at all.
    whole: bool = True

    @property
    def name(self) -> str:
        """The command, without what it is given."""
        known = [word for word in self.words if word.replace("-", "").isalpha() and word.islower()]
        groups = ("data", "sim", "challenge", "leaderboard", "dev")
        return " ".join(known[: 3 if known[1] in groups else 2])


_CAPTURE = ("capture/*.json", "capture/*.npz", "capture/frames/*", "capture/masks/*")
_TRUTH = ("capture/truth/*.npz", "capture/truth/*/*")
_RESULTS = ("results/results.json",)
_AVATAR = ("avatar/avatar.json", "avatar/model.safetensors")
_ENTRIES = ("entries/*.json", "entries/checks/*.json")
_BENCH, _HAND = "hwp-bench", "wildghand"

TARGETS = (
    Target((_BENCH, "data", "check", "capture"), (*_CAPTURE, *_TRUTH), weight=3.0),
    Target((_BENCH, "data", "show", "capture", "-o", "@out.png"), _CAPTURE,
           ("--frame-count", "--edge"), 2),
    Target((_BENCH, "data", "check", "capture", "--splits", "split.json"),
           ("split.json", *_CAPTURE), ("--guard",)),
    Target((_BENCH, "data", "inputs", "--capture", "capture", "-o", OUT),
           (*_CAPTURE, *_TRUTH), ("--name", "--splits")),
    Target((_BENCH, "challenge", "publish", "capture", "-o", OUT, "--splits", "split.json"),
           (*_CAPTURE, *_TRUTH, "split.json"), ("--splits",)),
    Target((_BENCH, "data", "import", "video", "seed.avi", "-o", OUT, "--landmarks",
            "landmarks.npz"),
           ("landmarks.npz", "seed.avi"),
           ("--size", "--range", "--stride", "--focal", "--id", "--action", "--licence")),
    Target((_BENCH, "data", "track", "seed.avi", "-o", "@out.npz", "--model", "landmarks.npz"),
           ("seed.avi", "landmarks.npz"), ("--min-score",), 0.3),
    Target((_BENCH, "data", "import", "wildghand", "inputs", "-o", OUT, "--mano", "mano"),
           ("mano/*",), ("--size", "--id", "--fps"), 0.3),
    Target((_BENCH, "data", "import", "interhand26m", "inputs", "x", "-o", OUT, "--mano", "mano"),
           ("mano/*",), ("--size", "--fps"), 0.3),
    Target((_BENCH, "data", "convert", "capture", "-o", OUT, "--hand-model", "mano:mano"),
           ("mano/*", *_CAPTURE), weight=1.5),
    Target((_BENCH, "data", "export", "capture", "-o", "@out.obj"), _CAPTURE, ("--frame",)),
    Target((_BENCH, "table", "results"), _RESULTS, ("--baseline", "--paper", "--by"), 3),
    Target((_BENCH, "table", "results", "--by", "details", "--format", "csv"), _RESULTS, weight=2),
    Target((_BENCH, "compare", "results", "results"), _RESULTS, ("--seed", "--resamples")),
    Target((_BENCH, "curves", "results", "-o", OUT), _RESULTS, ("--budgets", "--metric"), 2),
    Target((_BENCH, "report", "results", "-o", OUT, "--capture", "capture"),
           (*_RESULTS, *_CAPTURE), ("--title", "--baseline"), 2),
    Target((_BENCH, "verify", "results", "--capture", "capture"),
           (*_RESULTS, "results/captures/*/predictions/*", "results/tables/*", *_CAPTURE),
           ("--splits",), 2),
    Target((_BENCH, "leaderboard", "check", "--entries", "entries"), _ENTRIES, weight=2),
    Target((_BENCH, "leaderboard", "show", "--entries", "entries"), _ENTRIES),
    Target((_BENCH, "leaderboard", "build", "--entries", "entries", "-o", OUT),
           _ENTRIES, weight=2),
    Target((_BENCH, "dev", "leaderboard", "add", "results", "--entries", "entries"), _RESULTS,
           whole=False),
    Target((_BENCH, "leaderboard", "submit", "results", "-o", OUT, "--entries", "entries"),
           _RESULTS, ("--author", "--link")),
    Target((_BENCH, "dev", "leaderboard", "confirm", "results", "--checked-by", "x",
            "--entries", "entries"),
           (*_RESULTS, *_ENTRIES), ("--tolerance", "--entry"), whole=False),
    Target((_BENCH, "challenge", "check", "sealed/publication/public", "revealed.json",
            "--no-render"), ("sealed/publication/public/*.json", "revealed.json")),
    Target((_BENCH, "challenge", "reveal", "sealed", "-o", "@out.json"),
           ("sealed/keeper/secret.json", "sealed/publication/*/*.json",
            "sealed/publication/sealed/*/*.json")),
    Target((_BENCH, "challenge", "make", "capture0", "-o", OUT, "--secret", "revealed.json",
            "--workers", "1"), ("revealed.json",), ("--frame-count", "--size", "--secret"),
           0.3, False),
    Target((_BENCH, "evaluate", "submission", "--sealed", "sealed/publication/sealed", "-o", OUT,
            "--isolation", "none"),
           ("sealed/publication/*/*.json", "sealed/publication/sealed/*/*"), ("--steps",),
           0.5, False),
    Target((_BENCH, "sim", "render", "scene.toml", "-o", OUT, "--frame-count", "10", "--size", "16",
            "--workers", "1", "--no-free-view"), ("scene.toml",),
           ("--frame-count", "--size", "--severity", "--subject", "--seed"), 2),
    Target((_BENCH, "dev", "plan", "scene.toml", "--no-probe"), ("scene.toml",),
           ("--frame-count",), 2),
    Target((_BENCH, "evaluate", "submission", "--capture", "capture", "-o", OUT,
            "--isolation", "none"),
           ("submission/method.toml", "submission/predictions/*/*", *_CAPTURE, *_TRUTH),
           ("--set", "--splits", "--steps", "--budget", "--seed"), 2, False),
    Target((_BENCH, "evaluate", "gray", "--capture", "capture", "-o", OUT, "--isolation", "none"),
           ("gray/method.toml",), ("--set", "--preset", "--time-limit", "--memory-limit"),
           1, False),
    Target((_BENCH, "ablate", "gray", "--capture", "capture", "-o", OUT, "--seeds", "1",
            "--isolation", "none"), ("gray/method.toml",), ("--set", "--without"), 0.3, False),
    Target((_BENCH, "error-budget", "gray", "--capture", "capture", "-o", OUT),
           ("gray/method.toml",), ("--seed", "--truths"), 0.3, False),
    Target((_BENCH, "list", "methods"), (), ("--json",), 0.1),
    Target((_BENCH, "completion", "bash"), (), (), 0.1),
    Target((_HAND, "info"), (), (), 0.1),
    Target((_HAND, "fit", "capture", "-o", OUT, *FIT, "--prior", "prior"),
           (*_CAPTURE, "prior/*"), ("--set", "--seed", "--steps", "--budget"), 2),
    Target((_HAND, "fit", "seed.avi", "-o", OUT, *FIT, "--landmarks", "landmarks.npz"),
           ("seed.avi", "landmarks.npz"), ("--set", "--seed"), 0.5, False),
    Target((_HAND, "pretrain", "capture", "-o", OUT, *FIT), _CAPTURE, ("--set", "--seed"),
           0.5, False),
    Target((_HAND, "render", "avatar", "--poses", "capture", "-o", OUT, "--range", "0:2"),
           (*_AVATAR, *_AVATAR, *_CAPTURE[:2]), ("--range", "--background", "--hand-model"), 3),
    Target((_HAND, "export", "avatar", "-o", "@out.ply"), _AVATAR, ("--scale", "--frame"), 2),
    Target((_HAND, "export", "avatar", "-o", "@out.glb", "--mesh"), _AVATAR, ("--scale",)),
    Target((_HAND, "page", "avatar", "-o", "@out.html"), _AVATAR),
    Target((_HAND, "explain", "avatar", "capture", "-o", "@out.png"), (*_AVATAR, *_CAPTURE),
           ("--frames",)),
    Target((_HAND, "judge", "capture", "-o", "@out.json"), _CAPTURE),
    Target((_HAND, "completion", "zsh"), (), (), 0.1),
)  # fmt: skip


def preload() -> dict[str, Callable[[Sequence[str]], int]]:
    """Load every module that a command loads, so that a fork has them; return the programs."""
    from hwp_bench.cli.main import command_tree, main
    from hwp_bench.cli.program import whole_parser
    from wildghand.cli.main import command_tree as hand_tree
    from wildghand.cli.main import main as hand_main

    whole_parser(_BENCH, command_tree())
    whole_parser(_HAND, hand_tree())
    import torch

    torch.set_num_threads(1)  # a pool of threads does not live on in a fork
    for name in (
        "cv2", "OpenImageIO", "scipy.sparse", "scipy.spatial", "safetensors.torch", "psutil",
        "hwp_bench.evaluation.evaluate", "hwp_bench.report.page", "hwp_bench.capture.check",
        "hwp_bench.leaderboard.entries", "hwp_bench.commitments", "hwp_bench.sim",
        "hwp_bench.sim.produce.capture", "wildghand.avatar.files", "wildghand.fitting",
        "wildghand.export.formats", "wildghand.from_video.make", "matplotlib",
    ):  # fmt: skip
        try:
            importlib.import_module(name)
        except ImportError:  # it only takes longer
            continue
    gc.collect()
    gc.freeze()
    return {_BENCH: main, _HAND: hand_main}


@dataclass
class Tally:
    """What was tried and found."""

    #: Cases by command.
    commands: collections.Counter[str]
    #: Cases by the kind of what was changed.
    schemas: collections.Counter[str]
    #: Cases by exit status.
    statuses: collections.Counter[int]
    #: Folders of what was found, each with its first fault.
    found: list[tuple[str, str]]


def fuzz(
    targets: Sequence[Target],
    seeds: Path,
    keep: Path,
    *,
    seed: int,
    minutes: float = 0.0,
    cases: int = 0,
    first: int = 0,
) -> Tally:
    """Try cases until a time or a number is reached; case N of a seed is always the same.

    Args:
        targets: commands to try.
        seeds: folder that `make_seeds` has filled.
        keep: where cases are kept that a command did not end well in.
        seed: of all choices.
        minutes: how long.
        cases: how many; 0 for as many as the time allows.
        first: number of the first case.
    """
    programs = preload()
    tally = Tally(collections.Counter(), collections.Counter(), collections.Counter(), [])
    end = time.monotonic() + 60.0 * minutes
    number = first
    with tempfile.TemporaryDirectory(prefix="hwp-fuzz-") as name:
        while (number - first < cases) if cases else (time.monotonic() < end):
            _try_case(number, targets, seeds, keep, Path(name), programs, seed, tally)
            number += 1
    return tally


def refuse_empty(targets: Sequence[Target], seeds: Path) -> None:
    """Refuse patterns that no seed fits: nothing would be changed, and all would seem well.

    Raises:
        SystemExit: there is one; it is named.
    """
    for target in targets:
        for pattern in target.files:
            if not any(path.is_file() for path in seeds.glob(pattern)):
                raise SystemExit(f"{target.name}: no seed fits {pattern}")


def _try_case(
    number: int,
    targets: Sequence[Target],
    seeds: Path,
    keep: Path,
    work: Path,
    programs: dict[str, Callable[[Sequence[str]], int]],
    seed: int,
    tally: Tally,
) -> None:
    chance = random.Random(f"{seed} {number}")
    # The first round gives each command its turn.
    target = (
        targets[number]
        if number < len(targets)
        else chance.choices(targets, [item.weight for item in targets])[0]
    )
    folder = work / f"case-{number}"
    needed = {pattern.split("/")[0] for pattern in target.files} | {
        word.removeprefix("mano:").split("/")[0] for word in target.words
    }
    folder.mkdir()
    for part in sorted(needed):
        if (seeds / part).is_dir():
            shutil.copytree(seeds / part, folder / part, copy_function=os.link)
        elif (seeds / part).is_file():
            os.link(seeds / part, folder / part)
    words, how = _change(target, folder, chance)
    before = frozenset(folder.rglob("*"))
    kept = keep / f"case-{seed}-{number}"
    ended = run_forked(programs[words[0]], words[1:], folder)
    whole = [folder / word for word in words if word.startswith("out") and target.whole]
    faults = faults_of(ended, folder, before, whole)
    tally.commands[target.name] += 1
    tally.schemas[how.split(":")[0].split("/")[-1]] += 1
    tally.statuses[ended.status] += 1
    if faults:
        shutil.copytree(folder, kept, dirs_exist_ok=True, symlinks=True)
        said = f"{shlex.join(words)}\n{how}\n" + "\n".join(faults) + "\n"
        (kept / "FOUND.txt").write_bytes(said.encode("utf-8", "surrogatepass"))
        (kept / "STDERR.txt").write_bytes(ended.err)
        tally.found.append((str(kept), f"{target.name}: {how}: {faults[0]}"))
        text = tally.found[-1][1].encode("ascii", "backslashreplace").decode()
        print(f"FOUND {kept.name} {text[:400]!r}", flush=True)
    shutil.rmtree(folder, ignore_errors=True)


def _change(target: Target, folder: Path, chance: random.Random) -> tuple[list[str], str]:
    """Change files, an option or a name of a case; return its words, and how it was changed."""
    words = [word.replace("@", "") if word.startswith("@") else word for word in target.words]
    files = sorted(
        {path for pattern in target.files for path in folder.glob(pattern) if path.is_file()}
    )
    way = chance.random()
    if target.options and (way < 0.25 or not files):
        option = chance.choice(target.options)
        value = chance.choice(WORDS)
        if option == "--set":
            name = chance.choice(
                (
                    "level",
                    "gaussians",
                    "schedule.batch",
                    "network.size",
                    "mode",
                    "device",
                    "x",
                    "a.b",
                )
            )
            value = f"{name}={value}"
        # A word longer than the system's limit can reach no program.
        value = value[:100_000].replace("\0", "")
        return [*words, f"{option}={value}"], f"option {option}: {value[:60]!r}"
    if way < 0.32:
        inputs = [i for i, word in enumerate(words) if i and (folder / word).exists()]
        if inputs:
            index = chance.choice(inputs)
            new = os.fsdecode(chance.choice(NAMES)) + Path(words[index]).suffix
            (folder / words[index]).rename(folder / new)
            words[index] = f"./{new}"
            return words, f"a name: {new!r}"
    if not files:
        return words, "nothing: as it is"
    # Kinds of files in turn, for there are many images and few descriptions.
    groups = collections.defaultdict(list)
    for path in files:
        groups[(path.parent, path.suffix)].append(path)
    chosen = [chance.choice(groups[chance.choice(sorted(groups))])]
    if chance.random() < 0.15:
        chosen.append(chance.choice(files))
    told = [mutate(path, chance) for path in dict.fromkeys(chosen)]
    return words, " and ".join(told)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=10.0, help="how long (default 10)")
    parser.add_argument("--cases", type=int, default=0, help="how many, instead of how long")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0, help="of all choices (default 0)")
    parser.add_argument(
        "--only", nargs="+", metavar="WORD", help="commands with one of these words"
    )
    parser.add_argument(
        "--seeds", type=Path, help="folder of valid inputs, made if it is not there"
    )
    parser.add_argument(
        "--keep", type=Path, default=Path("fuzz-found"), help="folder for what is found"
    )
    args = parser.parse_args(arguments)
    chosen = [t for t in TARGETS if not args.only or {*args.only} & {*t.words}]
    if not chosen:
        parser.error("no command has such a word")
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="hwp-fuzz-seeds-") as name:
        seeds = args.seeds or Path(name) / "seeds"
        if not seeds.exists():
            seeds.mkdir(parents=True)
            make_seeds(seeds)
        refuse_empty(chosen, seeds)
        tally = fuzz(
            chosen, seeds.absolute(), args.keep.absolute(), seed=args.seed, minutes=args.minutes,
            cases=args.cases, first=args.first,
        )  # fmt: skip
    for title, counts in (
        ("command", tally.commands), ("what was changed", tally.schemas), ("status", tally.statuses)
    ):  # fmt: skip
        print(f"| {title} | cases |\n| --- | ---: |")
        for item, count in sorted(counts.items(), key=lambda pair: -pair[1]):
            text = str(item).encode("ascii", "backslashreplace").decode()
            print(f"| {text} | {count} |")
    total, seconds = sum(tally.commands.values()), time.monotonic() - begun
    print(f"{total} cases in {seconds:.0f} s, seed {args.seed}: {len(tally.found)} found")
    return 1 if tally.found else 0


if __name__ == "__main__":
    raise SystemExit(main())
