"""Public and sealed parts. Oracles: the pixels themselves, and an evaluation of the captures."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker
from small_methods import write_submission

from hwp_bench.base.errors import BadCapture, BadInput, UsageError
from hwp_bench.base.files import canonical_json
from hwp_bench.base.images import pixel_digest, read_rgb, write_image
from hwp_bench.capture import Capture, CaptureWriter
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.cli.main import main
from hwp_bench.commitments import Publication, open_sealed, publish
from hwp_bench.commitments.publication import commitment, target_content
from hwp_bench.methods.request import open_request

SALT = "5a" * 32


@pytest.fixture
def captures(make_capture: CaptureMaker) -> list[Capture]:
    return [make_capture("one", truth=True, size=48), make_capture("two", hands="both", size=48)]


@pytest.fixture
def publication(captures: list[Capture], tmp_path: Path) -> Publication:
    return publish([c.root for c in captures], tmp_path / "publication", salt=SALT)


def test_authors_get_no_test_pixel_and_no_truth(
    captures: list[Capture], publication: Publication
) -> None:
    for capture in captures:
        folder = publication.public / capture.info.id
        hidden = {pixel_digest(capture.frame(frame)) for frame in (18, 19)}
        hidden |= {pixel_digest(capture.mask(frame)) for frame in (18, 19)}
        images = sorted(folder.rglob("*.png"))
        assert len(images) == 2 * 18
        assert not hidden & {pixel_digest(read_rgb(image)) for image in images}
        request = open_request(folder)
        assert list(request.targets) == [18, 19]
        np.testing.assert_array_equal(request.frame(3), capture.frame(3))
        assert len(request.hands["right"].pose) == 20
    text = "".join(p.read_text() for p in publication.public.rglob("*.json"))
    for word in ("truth", "motion_blur", "severity", SALT, str(captures[0].root.parent)):
        assert word not in text
    # Nor any digest by which a guessed frame could be tested.
    for capture in captures:
        for digest in (capture.info.digests or {}).values():
            assert digest not in text


@pytest.mark.parametrize("frame", [3, 18])
def test_a_capture_that_was_changed_is_not_published(
    captures: list[Capture], tmp_path: Path, frame: int
) -> None:
    # Its evaluations would be refused, and the commitment would stand.
    image = captures[1].root / "masks" / f"{frame:06d}.png"
    write_image(image, np.full((48, 48), 255, dtype=np.uint8))
    with pytest.raises(BadCapture, match=r"digests\.masks: does not match the content"):
        publish([captures[1].root], tmp_path / "publication")
    assert not (tmp_path / "publication").exists()


def test_a_test_frame_that_cannot_be_scored_is_not_published(
    captures: list[Capture], tmp_path: Path
) -> None:
    two = captures[1]
    with CaptureWriter(tmp_path / "empty", two.info, two.hands, two.cameras) as writer:
        for frame in range(20):
            writer.frame(frame, two.frame(frame))
            writer.mask(frame, two.mask(frame) * (frame != 18))
    with pytest.raises(BadCapture, match="mask of frame 18 leaves no pixel to score"):
        publish([tmp_path / "empty"], tmp_path / "publication")


def test_the_sealed_part_is_closed_before_anything_is_in_it(
    captures: list[Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hwp_bench.commitments import publication as parts

    honest, modes = parts._copy_sealed, []

    def look(capture: Capture, target: Path) -> None:
        honest(capture, target)
        modes.append(target.parent.stat().st_mode & 0o777)

    monkeypatch.setattr(parts, "_copy_sealed", look)
    publish([captures[0].root], tmp_path / "out")
    assert modes == [0o700]
    # What is there is refused before every image is read.
    monkeypatch.setattr(parts, "target_content", lambda *_: pytest.fail("read"))
    with pytest.raises(UsageError, match="exists already"):
        publish([captures[0].root], tmp_path / "out")


def test_of_two_publications_at_once_one_is_told_and_no_salt_is_lost(
    captures: list[Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the salt on disc is that of the call that succeeded."""
    from hwp_bench.commitments import publication as parts

    out, sources = tmp_path / "publication", [captures[0].root]
    honest, first = parts.write_request, []

    def meanwhile(*arguments: Any) -> Path:
        monkeypatch.setattr(parts, "write_request", honest)
        first.append(publish(sources, out, salt=SALT))
        return honest(*arguments)

    monkeypatch.setattr(parts, "write_request", meanwhile)
    with pytest.raises(UsageError, match="exists already"):
        publish(sources, out, salt="00" * 32)
    assert json.loads((out / "sealed" / parts.KEY).read_text())["salt"] == SALT
    assert open_sealed(first[0].sealed).commitment == first[0].commitment


def test_the_commitment_can_be_computed_by_hand_and_needs_the_salt(
    captures: list[Capture], publication: Publication
) -> None:
    manifest = json.loads((publication.public / "manifest.json").read_text())
    digests = []
    for capture, entry in zip(captures, manifest["captures"], strict=True):
        frames = [
            [f, pixel_digest(capture.frame(f)), pixel_digest(capture.scoring_mask(f)[0]), truth]
            for f in (18, 19)
            for truth in [capture.info.id == "one"]
        ]
        split = contiguous_split(capture.info.id, 20).digest
        content = canonical_json({"id": capture.info.id, "split": split, "frames": frames})
        digest = hashlib.sha256(f"hwp-commitment/1\n{SALT}\n{content}".encode()).hexdigest()
        assert entry["commitment"] == digest
        digests.append(digest)
    joined = hashlib.sha256("\n".join(["hwp-commitment/1", *digests]).encode()).hexdigest()
    assert manifest["commitment"] == publication.commitment == joined
    content = target_content(captures[0], contiguous_split("one", 20))
    assert commitment(content, SALT) != commitment(content, "5b" * 32)


def test_two_publications_of_one_content_look_unrelated(
    captures: list[Capture], tmp_path: Path
) -> None:
    first, second = (publish([captures[0].root], tmp_path / name) for name in ("a", "b"))
    assert first.commitment != second.commitment
    assert open_sealed(first.sealed).commitment == first.commitment
    key = json.loads((first.sealed / "sealed.json").read_text())
    assert len(bytes.fromhex(key["salt"])) == 32
    assert (first.sealed.stat().st_mode & 0o077) == 0


def test_a_changed_sealed_part_is_refused(
    publication: Publication, captures: list[Capture]
) -> None:
    sealed, key = publication.sealed, publication.sealed / "sealed.json"
    assert [path.name for path in open_sealed(publication.sealed.parent).captures] == ["one", "two"]
    image = sealed / "one" / "frames" / "000018.png"
    original, words = image.read_bytes(), key.read_text()
    pixels = captures[0].frame(18).copy()
    pixels[0, 0, 0] ^= 1
    write_image(image, pixels)
    with pytest.raises(BadInput, match="not what was committed to") as caught:
        open_sealed(sealed)
    assert caught.value.field == "one"
    image.write_bytes(original)
    for old, new in ((SALT, "5b" * 32), ('"test"', '"tset"'), ('"id": "two"', '"id": "../two"')):
        key.write_text(words.replace(old, new))
        with pytest.raises(BadInput):
            open_sealed(sealed)
    key.write_text(words)
    manifest = publication.public / "manifest.json"
    manifest.write_text(manifest.read_text().replace(publication.commitment, "0" * 64))
    with pytest.raises(BadInput, match="a commitment that is not this sealed part's"):
        open_sealed(sealed)


def test_masks_are_committed_to(publication: Publication) -> None:
    mask = publication.sealed / "two" / "masks" / "000019.png"
    write_image(mask, np.full((48, 48), 255, dtype=np.uint8))
    with pytest.raises(BadInput, match="committed"):
        open_sealed(publication.sealed)


def test_submissions_are_scored_against_the_sealed_part(
    captures: list[Capture], publication: Publication, tmp_path: Path, capsys
) -> None:
    images = {
        f"{capture.info.id}/{frame:06d}.png": capture.frame(frame) // 2
        for capture in captures
        for frame in (18, 19)
    }
    entry = write_submission(tmp_path / "entry", images, "half")
    words = ["evaluate", str(entry), "--json", "--out"]
    assert main([*words, str(tmp_path / "s"), "--sealed", str(publication.sealed)]) == 0
    shown = capsys.readouterr()
    sealed = json.loads(shown.out)
    assert publication.commitment in shown.err
    assert sealed["suite"] == f"sealed-{publication.commitment[:12]}"
    roots = [str(capture.root) for capture in captures]
    assert main([*words, str(tmp_path / "c"), "--capture", *roots]) == 0
    plain = json.loads(capsys.readouterr().out)
    for first, second in zip(sealed["captures"], plain["captures"], strict=True):
        assert first["frames"] == second["frames"]
        assert first["digest"] == second["digest"]
    refused = [*words, str(tmp_path / "x"), "--sealed", str(publication.sealed)]
    for option in ("--capture", "--suite"):
        with pytest.raises(SystemExit) as stop:
            main([*refused, option, "smoke"])
        assert stop.value.code == 2
        assert f"argument {option}: not allowed with argument --sealed" in capsys.readouterr().err
    assert main([*refused, "--splits", "y"]) == 2
    assert "--sealed: has its own splits" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_the_command(captures: list[Capture], tmp_path: Path, capsys) -> None:
    words = ["challenge", "publish", str(captures[0].root), "-o", str(tmp_path / "p")]
    assert main(words) == 0
    assert "commitment: " in capsys.readouterr().out
    assert main(words) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "q"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["captures"] == ["one"]


def test_what_cannot_be_published_is_refused(captures: list[Capture], tmp_path: Path) -> None:
    with pytest.raises(BadCapture, match="too"):
        publish([captures[0].root, captures[0].root], tmp_path / "p")
    with pytest.raises(UsageError):
        publish([], tmp_path / "p")
    (captures[0].root / "frames" / "000019.png").write_bytes(b"")
    with pytest.raises(BadInput, match="empty"):
        publish([captures[0].root], tmp_path / "p")
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"salt": "5a"}, "salt: "),
        ({"captures": []}, r"captures: is \[\], expected a list of at least 1 entries"),
        ({"captures": [{"split": {}, "commitment": "0"}]}, r"captures\[0\].id: is missing"),
        ({"commitment": None}, "commitment: "),
        ({"schema": "hwp-sealed/2"}, "schema: is 'hwp-sealed/2' where 'hwp-sealed/1' is read"),
    ],
)
def test_a_wrong_field_of_the_key_file_is_named(
    publication: Publication, change: dict[str, Any], problem: str
) -> None:
    key = publication.sealed / "sealed.json"
    key.write_text(json.dumps({**json.loads(key.read_text()), **change}))
    with pytest.raises(BadInput, match=rf"sealed\.json: {problem}"):
        open_sealed(publication.sealed)
