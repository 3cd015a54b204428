"""Shadows that hands cast on themselves and on each other, and how bright they make Gaussians."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.rays import ray_mesh
from hwp_bench.hands import TemplateTensors, pose_hand, vertex_normals
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import TrainingClip, upload
from wildghand.light.light import DARKEST, SRGB, CastLight

#: How far a ray starts from the skin, m: the surface of an estimated hand is not exact, and a
#: fold must not shade itself.
LIFT = 2e-3
# Cosine between normal and direction up to which a place has no light from there anyway.
_GRAZING = 0.02


def obstacles_in_frames(
    surfaces: Sequence[tuple[np.ndarray, np.ndarray]],
) -> Iterator[Obstacles]:
    """The hands of one frame after the other.

    Args:
        surfaces: (B, V, 3) m in B frames and (F, 3) of each hand, at least one.
    """
    for frame in range(len(surfaces[0][0])):
        yield Obstacles([(vertices[frame], faces) for vertices, faces in surfaces])


class Obstacles:
    """The surfaces of one hand or two in one pose.

    Args:
        surfaces: (V, 3) m and (F, 3) of each hand.

    Raises:
        HwpError: Embree refuses the mesh.
    """

    def __init__(self, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in surfaces)])
        self._mesh = ray_mesh(
            np.concatenate([vertices for vertices, _ in surfaces]),
            np.concatenate([faces + s for (_, faces), s in zip(surfaces, starts, strict=False)]),
        )

    def free(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether light from far away reaches places of the surface.

        Args:
            points: (M, 3) m.
            normals: (M, 3) of length 1.
            directions: (K, 3) towards the light, of length 1.

        Returns:
            (M, K) float64, 0 where a hand is in the way and 1 elsewhere, also where the place
            faces away from the light.
        """
        free = np.ones((len(points), len(directions)))
        place, way = np.nonzero(normals @ directions.T > _GRAZING)
        starts = (points + LIFT * normals)[place].astype(np.float64)
        blocked = self._mesh.blocked(starts, directions[way].astype(np.float64))
        free[place[blocked], way[blocked]] = 0.0
        return free


# Least and largest irradiance that skin is drawn in: where little is seen the light may be wrong.
_DIM, _BRIGHT = 0.15, 4.0

#: Pose (B, 16, 3) rad, betas (10,) or (B, 10), and translation (B, 3) m.
Hand = tuple[Tensor, Tensor, Tensor]
#: By side.
Hands = Mapping[str, Hand]


class HandShadows:
    """Hands under a light, and the shadows that they cast.

    Shadows are cast at the vertices of the posed templates, and Gaussians take them from the
    vertices around their anchors. There is no gradient.

    Args:
        rigs: by side; the light of each is kept off by all that are posed with it.
        light: under which they stand.
        darkest: share of the light that is left in the darkest shadow.
    """

    def __init__(
        self,
        rigs: Mapping[str, HandRig],
        light: CastLight,
        *,
        darkest: float = DARKEST,
    ) -> None:
        self._darkest = darkest
        self._templates = {side: _on_cpu(rig.template) for side, rig in rigs.items()}
        self._faces = {side: made.faces.numpy() for side, made in self._templates.items()}
        self.light = light.lit()
        device = next(iter(rigs.values())).template.vertices.device
        self._directions = torch.from_numpy(self.light.directions).to(device).double()
        self._strengths = torch.from_numpy(self.light.strengths).to(device).double()
        self._corners: dict[str, tuple[Tensor, Tensor]] = {}
        for side, rig in rigs.items():
            faces = torch.as_tensor(rig.anchors.face_index, device=rig.template.faces.device)
            self._corners[side] = (
                rig.template.faces[faces],
                torch.as_tensor(rig.anchors.barycentric).to(rig.template.vertices),
            )

    @torch.no_grad()
    def shading(self, normals: Tensor) -> Tensor:
        """Factors on the sRGB colours of skin with nothing in the way.

        Args:
            normals: (B, N, 3) of length 1.

        Returns:
            (B, N), 1 at the mean irradiance of what the light was found in.
        """
        # In float64, frame by frame: rounded, a frame has the same bits in every batch.
        falling = torch.stack(
            [
                (one.double() @ self._directions.mT).clamp(min=0.0) @ self._strengths
                for one in normals
            ]
        )
        return (falling + self.light.ambient).clamp(_DIM, _BRIGHT).pow(SRGB).to(normals)

    def of(self, hands: Hands) -> dict[str, Tensor]:
        """Factors on the sRGB colours of the Gaussians of hands that stand together.

        Returns:
            (B, N) in (0, 1] by side.
        """
        return {
            side: self.spread(side, upload(torch.from_numpy(dark), hands[side][0].device))
            for side, dark in self.at_vertices(hands).items()
        }

    def spread(self, side: str, dark: Tensor) -> Tensor:
        """Factors (B, N) of Gaussians from those of vertices (B, V)."""
        corners, mix = self._corners[side]
        return (dark[:, corners] * mix).sum(dim=-1)

    @torch.no_grad()
    def at_vertices(self, hands: Hands) -> dict[str, np.ndarray]:
        """Factors at the vertices: (B, V) float32 by side; see `of`."""
        posed = {side: self._posed(side, *given) for side, given in hands.items()}
        dark = {side: np.empty(places.shape[:2], np.float32) for side, (places, _) in posed.items()}
        surfaces = [(places, self._faces[side]) for side, (places, _) in posed.items()]
        for frame, in_the_way in enumerate(obstacles_in_frames(surfaces)):
            for side, (places, normals) in posed.items():
                dark[side][frame] = self._dark(in_the_way, places[frame], normals[frame])
        return dark

    def _dark(self, in_the_way: Obstacles, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        free = in_the_way.free(places, normals, self.light.directions)
        return self.light.darkening(normals, free, self._darkest)

    def _posed(
        self, side: str, pose: Tensor, betas: Tensor, transl: Tensor
    ) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and normals, (B, V, 3) each."""
        template = self._templates[side]
        given = (each.detach().float().cpu() for each in (pose, betas, transl))
        vertices = pose_hand(template, *given).vertices
        return vertices.numpy(), vertex_normals(vertices, template.faces).numpy()


class ShadowTable:
    """The factors in the frames of a clip, cast when they are first asked for.

    Args:
        shadows: of the hands.
        clip: their poses in R frames.
    """

    def __init__(self, shadows: HandShadows, clip: TrainingClip) -> None:
        self._shadows = shadows
        self._device = clip.viewmats.device
        # Copies, so that nobody waits for the device later.
        self._hands = {
            side: tuple(given.cpu() for given in parameters)
            for side, parameters in clip.parameters.items()
        }
        self._known = np.zeros(len(clip.viewmats), dtype=bool)
        self._dark: dict[str, Tensor] = {}

    def __call__(self, rows: Tensor) -> dict[str, Tensor]:
        """Factors in some of the frames, as `HandShadows.of` returns them.

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
        """
        new = np.unique(rows.numpy()[~self._known[rows.numpy()]])
        if len(new):
            here = torch.from_numpy(new)
            hands = {
                side: (pose[here], betas, transl[here])
                for side, (pose, betas, transl) in self._hands.items()
            }
            for side, dark in self._shadows.at_vertices(hands).items():
                if side not in self._dark:
                    self._dark[side] = torch.ones(len(self._known), dark.shape[1])
                self._dark[side][here] = torch.from_numpy(dark)
            self._known[new] = True
        return {
            side: self._shadows.spread(side, upload(dark[rows], self._device))
            for side, dark in self._dark.items()
        }


def _on_cpu(template: TemplateTensors) -> TemplateTensors:
    """The same arrays as float32 on the CPU."""
    changed = {}
    for item in dataclasses.fields(template):
        tensor = getattr(template, item.name)
        if tensor is not None:
            tensor = tensor.detach().cpu()
            changed[item.name] = tensor.float() if tensor.is_floating_point() else tensor
    return dataclasses.replace(template, **changed)
