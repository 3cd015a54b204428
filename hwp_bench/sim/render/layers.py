"""Linear light and geometry of a frame as a layered OpenEXR file.

Channels: R, G, B (linear light of the clean instant), Z (depth, m), N.X N.Y N.Z (normal in
camera axes), id (0 backdrop, 1 right hand, 2 left hand, 3 sleeve, arm
or worn on the wrist, 4 object), motion.X motion.Y
(way on the screen to the next frame, px). One ray through the centre of each pixel; the
backdrop has depth 0.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import HwpError
from hwp_bench.sim.effects.plan import hands_at, lights_at, objects_at
from hwp_bench.sim.geometry.raycast import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import join
from hwp_bench.sim.render.frame import SimulatedFrame
from hwp_bench.sim.render.instant import Lens, render_instant
from hwp_bench.sim.render.stage import Stage
from hwp_bench.sim.scene.optics import intrinsics, pixel_rays, viewmat
from hwp_bench.sim.scene.schema import Scene

#: Names of the channels, in their order.
CHANNELS = ("R", "G", "B", "Z", "N.X", "N.Y", "N.Z", "id", "motion.X", "motion.Y")
_OBJECT = 4


def frame_layers(scene: Scene, result: SimulatedFrame, frame_count: int, size: int) -> np.ndarray:
    """Compute the layers of a frame: (S, S, 10) float32 in the order of `CHANNELS`."""
    recipe = result.plan
    stage = Stage(scene, RenderCost())
    seconds = recipe.seconds
    later = seconds + scene.duration / frame_count
    hands = hands_at(scene, seconds)
    view = viewmat(scene, seconds)
    lens = Lens(intrinsics(scene, size), view, size, 1, seconds=seconds)
    body = stage.traced(stage.surface(hands))
    things = stage.things(objects_at(scene, recipe, seconds), hands)
    image = render_instant(scene, lens, body, things, lights_at(scene, recipe), RenderCost())
    future_hands = hands_at(scene, later)
    now, then = body.surface, stage.surface(future_hands)
    owner = stage.owners(hands)
    if things is not None:
        later_things = stage.things(objects_at(scene, recipe, later), future_hands)
        assert later_things is not None
        owner = np.concatenate([owner, np.full(len(things.surface.faces), _OBJECT)])
        now, then = join([now, things.surface]), join([then, later_things.surface])
    layers = np.zeros((size * size, len(CHANNELS)), dtype=np.float32)
    layers[:, :3] = image.color.reshape(-1, 3)
    origin, directions = pixel_rays(lens.K, view, (0, size, 0, size), 1)
    rays = directions.reshape(-1, 3)
    hits = Tracer(now.vertices, now.faces, Counter()).first_hits(
        np.broadcast_to(origin, rays.shape), rays, "layers"
    )
    corners = now.faces[hits.face]

    def spread(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", hits.weights, values[corners])

    layers[hits.ray, 3] = hits.distance
    layers[hits.ray, 4:7] = spread(now.normals) @ view[:3, :3].T
    layers[hits.ray, 7] = owner[hits.face]
    before = _pixels(spread(now.vertices), lens.K, view)
    after = _pixels(spread(then.vertices), lens.K, viewmat(scene, later))
    layers[hits.ray, 8:] = after - before
    return layers.reshape(size, size, -1)


def write_layers(
    path: Path, scene: Scene, result: SimulatedFrame, frame_count: int, size: int
) -> None:
    """Write the layers of a frame as OpenEXR (32-bit floats, zip).

    Raises:
        HwpError: the file cannot be written.
    """
    import OpenImageIO as oiio

    layers = frame_layers(scene, result, frame_count, size)
    specification = oiio.ImageSpec(size, size, layers.shape[2], "float")
    specification.channelnames = CHANNELS
    specification.attribute("compression", "zip")
    specification.attribute("oiio:ColorSpace", "lin_rec709")
    temporary = path.with_name(f".{path.name}")
    file = oiio.ImageOutput.create(os.fspath(path))
    written = (
        file is not None
        and file.open(os.fspath(temporary), specification)
        and file.write_image(np.ascontiguousarray(layers))
        and file.close()
    )
    if not written:
        reason = file.geterror() if file is not None else oiio.geterror()
        raise HwpError(f"cannot be written ({reason.strip()})", where=path)
    os.replace(temporary, path)


def _pixels(points: np.ndarray, K: np.ndarray, view: np.ndarray) -> np.ndarray:
    in_camera = points @ view[:3, :3].T + view[:3, 3]
    return ((in_camera / in_camera[:, 2:]) @ K.T)[:, :2]
