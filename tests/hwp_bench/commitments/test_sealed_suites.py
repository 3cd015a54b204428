"""A sealed suite from its secret to its check. Oracles: the bytes of the public part, and the truth
submitted as an entry."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from small_methods import write_submission

from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.images import read_gray, read_rgb, write_image
from hwp_bench.capture import open_capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.cli.main import main
from hwp_bench.commitments import SealedSuite, make_suite, open_sealed
from hwp_bench.commitments import suite as making
from hwp_bench.commitments.publication import joint_commitment
from hwp_bench.commitments.recipe import derived, read_secret, recipe_of, sealed_items
from hwp_bench.methods.request import open_request
from hwp_bench.sim.subject import hand as atlas

RECIPE = recipe_of(["capture2"], 10, 40)
NAME = "sealed-capture2"
SECRETS = ("5a" * 32, "a5" * 32)


@pytest.fixture(scope="module", autouse=True)
def small_skin() -> Iterator[None]:
    """Skin of few texels: painting a person's whole one takes 8 seconds, and there are two."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlas, "ATLAS", 256)
        atlas.skin_atlas.cache_clear()
        yield
    atlas.skin_atlas.cache_clear()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> list[SealedSuite]:
    """Two suites of one recipe under two secrets."""
    root = tmp_path_factory.mktemp("suites")
    return [
        make_suite(root / str(k), RECIPE, secret=secret, workers=1)
        for k, secret in enumerate(SECRETS)
    ]


@pytest.fixture
def suite(made: list[SealedSuite], tmp_path: Path) -> Path:
    """A copy of the first suite's folder."""
    return shutil.copytree(made[0].secret.parents[1], tmp_path / "exam")


@pytest.fixture
def revealed(suite: Path, tmp_path: Path) -> Path:
    assert main(["challenge", "reveal", str(suite), "-o", str(tmp_path / "revealed.json")]) == 0
    return tmp_path / "revealed.json"


def checked(suite: Path, revealed: Path, work: Path, *more: str) -> int:
    """The exit status of a check; frames that were rendered once are taken."""
    shutil.copytree(suite / "keeper" / "captures", work, dirs_exist_ok=True)
    public = suite / "publication" / "public"
    words = ["challenge", "check", str(public), str(revealed), "--work", str(work), *more]
    return main(words)


def test_the_public_part_tells_no_seed(made: list[SealedSuite]) -> None:
    (item,) = sealed_items(RECIPE, SECRETS[0])
    hidden = [SECRETS[0], derived(SECRETS[0], "salt").hex(), item.scene.digest]
    hidden += [str(item.scene.seed), str(item.scene.subject.seed), f"{item.scene.seed:x}"]
    files = [path for path in made[0].public.rglob("*") if path.is_file()]
    assert len(files) > 10
    for path in files:
        data = path.read_bytes() + path.name.encode()
        assert not [text for text in hidden if text.encode() in data], path
        assert bytes.fromhex(SECRETS[0]) not in data
    # The same words are found where they are: the keeper's capture states its seed.
    capture = next(made[0].secret.parent.rglob("capture.json")).read_bytes()
    assert str(item.scene.seed).encode() in capture


def test_another_secret_is_another_person_in_other_pictures(made: list[SealedSuite]) -> None:
    one, other = (open_request(suite.public / NAME) for suite in made)
    frames = one.train.tolist()
    gap = [np.abs(one.frame(f).astype(int) - other.frame(f).astype(int)).mean() for f in frames]
    assert min(gap) > 2.0
    assert np.abs(one.hands["left"].betas - other.hands["left"].betas).max() > 0.1
    assert made[0].page.secret_commitment != made[1].page.secret_commitment
    assert made[0].page.frames_commitment != made[1].page.frames_commitment


def test_only_its_owner_may_read_the_secret(made: list[SealedSuite]) -> None:
    for suite in made:
        assert suite.secret.stat().st_mode & 0o777 == 0o600
        assert suite.secret.parent.stat().st_mode & 0o777 == 0o700
        assert suite.sealed.stat().st_mode & 0o777 == 0o700


def test_a_stopped_start_goes_on_with_its_secret(
    made: list[SealedSuite], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "exam"

    def stopped(*arguments: object, **named: object) -> None:
        raise HwpError("stopped")

    with monkeypatch.context() as patched:
        patched.setattr(making, "publish", stopped)
        patched.setattr(making, "ensure_suite", lambda *a, **k: [])
        with pytest.raises(HwpError, match="stopped"):
            make_suite(folder, RECIPE)
    secret = read_secret(folder / "keeper" / "secret.json")
    with pytest.raises(BadInput, match="another secret"):
        make_suite(folder, RECIPE, secret=SECRETS[0])
    sources = [made[0].secret.parent / "captures"]
    sources = sorted(path for path in sources[0].iterdir() if path.is_dir())
    monkeypatch.setattr(making, "ensure_suite", lambda *a, **k: sources)
    again = make_suite(folder, RECIPE)
    assert read_secret(again.secret) == secret
    with pytest.raises(UsageError, match="exists already"):
        make_suite(folder, RECIPE)


def test_the_truth_scores_perfectly(suite: Path, tmp_path: Path) -> None:
    part = open_sealed(suite / "publication")
    capture = open_capture(part.captures[0])
    frames = part.splits[NAME].test.tolist()
    images = {f"{NAME}/{frame_name(frame)}": capture.frame(frame) for frame in frames}
    entry = write_submission(tmp_path / "truth", images, "truth")
    out = tmp_path / "run"
    sealed = str(suite / "publication" / "sealed")
    assert main(["evaluate", str(entry), "--sealed", sealed, "-o", str(out)]) == 0
    results = json.loads((out / "results.json").read_text())
    assert results["suite"].startswith("sealed-")
    assert results["captures"][0]["frames"][0]["scores"]["psnr"] == 100.0


def test_an_honest_suite_holds(suite: Path, revealed: Path, tmp_path: Path, capsys) -> None:
    assert json.loads(revealed.read_text())["secret"] == SECRETS[0]
    capsys.readouterr()
    assert checked(suite, revealed, tmp_path / "work", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["holds"]
    assert [row["id"] for row in found["captures"]] == [NAME]
    assert checked(suite, revealed, tmp_path / "work", "--no-render", "--json") == 0
    assert json.loads(capsys.readouterr().out)["captures"] == []


@pytest.mark.slow
def test_captures_are_rendered_again_from_the_secret_alone(
    suite: Path, revealed: Path, tmp_path: Path
) -> None:
    public = suite / "publication" / "public"
    words = ["challenge", "check", str(public), str(revealed), "--work", str(tmp_path / "new")]
    assert main([*words, "--capture", NAME, "--workers", "1"]) == 0
    assert len(list((tmp_path / "new").glob(f"{NAME}-*/capture.json"))) == 1


@pytest.mark.parametrize("change", ["secret", "page", "recipe", "manifest", "other suite"])
def test_an_exchanged_secret_or_page_is_found_out(
    change: str, suite: Path, made, revealed: Path, tmp_path: Path, capsys
) -> None:
    public = suite / "publication" / "public"
    file, key = {
        "secret": (revealed, "secret"),
        "page": (public / "suite.json", "secret_commitment"),
        "recipe": (public / "suite.json", "recipe"),
        "manifest": (public / "manifest.json", "commitment"),
        "other suite": (public / "suite.json", "recipe"),
    }[change]
    content = json.loads(file.read_text())
    content[key] = {**content[key], "size": 48} if key == "recipe" else "0" * 64
    file.write_text(json.dumps(content))
    if change == "other suite":
        shutil.rmtree(public)
        shutil.copytree(made[1].public, public)
    capsys.readouterr()
    assert checked(suite, revealed, tmp_path / "work") == 1
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert "commit" in message


def test_frames_that_do_not_follow_from_the_secret_are_found_out(
    suite: Path, revealed: Path, tmp_path: Path, capsys
) -> None:
    """The organiser commits to other test frames, and publishes another training frame."""
    public = suite / "publication" / "public"
    manifest = json.loads((public / "manifest.json").read_text())
    manifest["captures"][0]["commitment"] = "0" * 64
    manifest["commitment"] = joint_commitment(["0" * 64])
    (public / "manifest.json").write_text(json.dumps(manifest))
    page = json.loads((public / "suite.json").read_text())
    page["frames_commitment"] = manifest["commitment"]
    (public / "suite.json").write_text(json.dumps(page))
    image = next((public / NAME / "frames").glob("*.png"))
    write_image(image, read_rgb(image) ^ 3)
    capsys.readouterr()
    assert checked(suite, revealed, tmp_path / "work") == 1
    assert "others than committed to, 1 training images differ by at most 3" in (
        capsys.readouterr().out
    )


@pytest.mark.parametrize("change", ["hands", "cameras", "size"])
def test_other_numbers_and_sizes_are_found_out(
    change: str, suite: Path, revealed: Path, tmp_path: Path, capsys
) -> None:
    """Hand parameters a degree off, cameras a pixel off, or images and record of another size."""
    public = suite / "publication" / "public" / NAME
    if change == "size":
        record = json.loads((public / "request.json").read_text())
        record["width"] *= 2
        (public / "request.json").write_text(json.dumps(record))
        for image in [*public.glob("frames/*.png"), *public.glob("masks/*.png")]:
            pixels = read_rgb(image) if image.parent.name == "frames" else read_gray(image)
            write_image(image, np.repeat(pixels, 2, axis=1))
    else:
        file = public / f"{change}.npz"
        arrays = dict(np.load(file))
        name = next(key for key in arrays if "pose" in key or key == "Ks")
        off = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]]) if change == "cameras" else 0.02
        arrays[name] = (arrays[name] + off).astype(arrays[name].dtype)
        np.savez(file, **arrays)
    capsys.readouterr()
    assert checked(suite, revealed, tmp_path / "work") == 1
    said = capsys.readouterr().out
    wanted = "differ by at most 255 of 255" if change == "size" else "cameras or the split differ"
    assert wanted in said


@pytest.mark.parametrize("place", ["keeper/secret.json", "publication/public/suite.json"])
def test_a_suite_that_would_convict_its_organiser_is_not_revealed(
    place: str, suite: Path, made: list[SealedSuite], tmp_path: Path, capsys
) -> None:
    shutil.copyfile(made[1].secret.parents[1] / place, suite / place)
    out = tmp_path / "revealed.json"
    assert main(["challenge", "reveal", str(suite), "-o", str(out)]) == 1
    assert "is committed to" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["make", "-o", "exam"], 2),
        (["make", "capture2", "--suite", "mini", "-o", "exam"], 2),
        (["make", "--suite", "mini", "--frame-count", "20", "-o", "exam"], 2),
        (["make", "capture77", "-o", "exam"], 2),
        (["make", "capture2", "--frame-count", "3", "-o", "exam"], 2),
        (["make", "capture2", "--secret", "nowhere.json", "-o", "exam"], 1),
        (["reveal", "nowhere", "-o", "revealed.json"], 1),
        (["check", "nowhere", "revealed.json"], 1),
    ],
)
def test_bad_words_are_one_message_and_leave_nothing(
    words: list[str], status: int, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["challenge", *words]) == status
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert message.count("error:") == 1
    assert list(tmp_path.iterdir()) == []
