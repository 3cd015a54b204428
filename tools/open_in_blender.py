"""Open a skinned hand of `wildghand export --mesh` in Blender, say what it found, and draw it.

It needs Blender as a Python package, in an environment of its own, and nothing of this toolkit:

    python3.11 -m venv blender && blender/bin/pip install bpy==4.2.23
    blender/bin/python tools/open_in_blender.py hand.glb -o picture

Every hand must have 16 weighted joints, a texture and a motion that moves it. The first and the
middle frame of the motion are drawn, as `picture-0.png` and `picture-1.png`. Exit status 1 where
something is missing.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import bpy
from mathutils import Vector

#: Joints of one hand.
JOINTS = 16
#: Mean motion of a vertex between the two frames that counts as a motion, m.
MOVED = 0.001


def posed(mesh: Any, frame: int) -> list[Any]:
    """Return the vertices of a skinned mesh in one frame, in the world."""
    bpy.context.scene.frame_set(frame)
    shown = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    places = [shown.matrix_world @ vertex.co for vertex in shown.to_mesh().vertices]
    shown.to_mesh_clear()
    return places


def faults_of(mesh: Any, first: int, middle: int) -> list[str]:
    """Print what Blender knows of one hand; return what is missing."""
    weighted = {group.group for vertex in mesh.data.vertices for group in vertex.groups}
    images = [
        tuple(node.image.size)
        for material in mesh.data.materials
        for node in material.node_tree.nodes
        if node.type == "TEX_IMAGE" and node.image is not None
    ]
    pairs = list(zip(posed(mesh, first), posed(mesh, middle), strict=True))
    moved = sum((one - other).length for one, other in pairs) / len(pairs)
    print(
        f"{mesh.name}: {len(mesh.data.vertices)} vertices, {len(weighted)} joints, "
        f"textures {images}, moves {1000 * moved:.1f} mm from frame {first} to {middle}"
    )
    wanted = (len(weighted) == JOINTS, bool(images), moved > MOVED)
    names = (f"not {JOINTS} joints", "no texture", "no motion")
    return [f"{mesh.name}: {name}" for good, name in zip(wanted, names, strict=True) if not good]


def draw(meshes: list[Any], frame: int, path: str) -> None:
    """Draw the hands from the front with Cycles, all in the picture."""
    scene = bpy.context.scene
    places = [place for mesh in meshes for place in posed(mesh, frame)]
    middle = sum(places, Vector()) / len(places)
    reach = max((place - middle).length for place in places)
    camera = scene.camera
    camera.location = middle + Vector((0.0, -3.2 * reach, 0.0))
    camera.rotation_euler = (middle - camera.location).to_track_quat("-Z", "Y").to_euler()
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def main() -> int:
    """Open the file and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help=".glb of `wildghand export --mesh`")
    parser.add_argument("-o", "--out", required=True, help="where pictures go, without -0.png")
    args = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=args.file)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    scene.render.resolution_x = scene.render.resolution_y = 480
    scene.world = bpy.data.worlds.new("world")
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    meshes = [one for one in bpy.data.objects if one.type == "MESH" and one.find_armature()]
    if not meshes or not bpy.data.actions:
        print("no skinned mesh or no motion", file=sys.stderr)
        return 1
    begin, end = bpy.data.actions[0].frame_range
    frames = (int(begin), int((begin + end) / 2))
    faults = [fault for mesh in meshes for fault in faults_of(mesh, *frames)]
    for index, frame in enumerate(frames):
        draw(meshes, frame, f"{args.out}-{index}.png")
    for fault in faults:
        print(fault, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
