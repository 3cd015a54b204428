"""Dynamic perturbation disentanglement: temporally weighted biases of Gaussian attributes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import BadInput, ShapeMismatch, UsageError
from wildghand.gaussians.attributes import CHANNELS, SIZES, RawAttributes
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.shading import sh_basis, sh_count

#: Joints whose skinning weights say where on the hand a Gaussian is.
_JOINTS = 16
#: Degree of the harmonics of the normal; light of degree 2 is enough for a matte surface.
_DEGREE = 2
#: Numbers of one place: the skinning weights, which add up to a constant, and the harmonics
#: without theirs.
PLACE_CHANNELS = _JOINTS + sh_count(_DEGREE) - 1


class BiasField(nn.Module):
    """F_l(x) = sum_k a_k(z_l) B_k x for every frame of a clip: 14 numbers at each Gaussian.

    x is the place: which bones move the Gaussian, and where its normal points in this frame. A
    light from the side is a field of colours over normals, a wrong finger one of offsets over
    bones. B starts at zero, hence F.

    Args:
        rank: K, at least 1.
        width: of the temporal embedding z.

    Raises:
        UsageError: `rank` is below 1.

    Source: ours; the paper's bias has the same shift for all Gaussians of a frame.
    """

    def __init__(self, rank: int, width: int) -> None:
        super().__init__()
        if rank < 1:
            raise UsageError(f"is {rank}", field="rank", remedy="Use 1 or more.")
        self.codes = nn.Linear(width, rank)
        self.maps = nn.Parameter(torch.zeros(rank, PLACE_CHANNELS, CHANNELS))

    def forward(self, z: Tensor, bones: Tensor, normals: Tensor) -> Tensor:
        """Evaluate the field.

        Args:
            z: (B, width) temporal embedding.
            bones: (N, 16) as from `bone_features`.
            normals: (B, N, 3) of length 1: the posed surface's, without gradient.

        Returns:
            (B, N, 14), in the order of the attributes.

        Raises:
            ShapeMismatch: the arguments do not describe the same Gaussians and frames.
        """
        if normals.shape != (len(z), len(bones), 3) or bones.shape[1] != _JOINTS:
            raise ShapeMismatch(
                f"are {tuple(z.shape)}, {tuple(bones.shape)} and {tuple(normals.shape)}",
                field="z, bones, normals",
            )
        # The sum over k first: one small matrix for each frame.
        maps = torch.einsum("bk,kpc->bpc", self.codes(z), self.maps)
        by_bone, by_normal = maps.split([_JOINTS, PLACE_CHANNELS - _JOINTS], dim=1)
        harmonics = sh_basis(normals, _DEGREE)[..., 1:]
        return torch.baddbmm(bones @ by_bone, harmonics, by_normal)


def bone_features(rig: HandRig) -> Tensor:
    """How far each bone moves each anchor, scaled so that a single bone counts 4.

    With 4, the square root of 16, their mean square is at most that of the harmonics, 1.

    Returns:
        (N, 16) float32, rows sum to 4.
    """
    corners = rig.template.weights[rig.template.faces[rig.anchors.face_index]]
    barycentric = torch.as_tensor(rig.anchors.barycentric).to(corners)
    return math.sqrt(_JOINTS) * torch.einsum("ncj,nc->nj", corners, barycentric)


#: K of the paper: the encoding has the octaves 0 to K.
OCTAVES = 9
#: Channels of the encoding: a sine and a cosine for each octave, and l / L itself.
ENCODED = 2 * (OCTAVES + 1) + 1


@dataclass(frozen=True)
class DpdSettings:
    """Dynamic perturbation disentanglement, and what is added to it."""

    #: Component: explain perturbations as biases of the attributes.
    enabled: bool = True
    #: Addition: a field of biases over place and normal, a gain of each frame's colours, and by the
    #: pre-pass where temporal weights start and are held, and which frames leave biases out.
    additions: bool = True
    #: The authors' pose head by time: small corrections of each frame's pose from its embedding.
    poses: bool = False

    #: Rank of the field.
    rank: ClassVar[int] = 6
    #: Temporal weight that a frame of the least weight in the pre-pass starts at and is held near.
    omega_scale: ClassVar[float] = 0.5
    #: Weight of the square of the log gains, for a frame that is surely clean; 2 wins nothing.
    gain_weight: ClassVar[float] = 0.1
    #: Weight of the square of what separates the log gains of a frame's channels: exposure wanders
    #: more than white balance, and a palm that only perturbed frames show is redder by itself.
    tint_weight: ClassVar[float] = 1.0
    #: Chance that a frame's biases are left out of a step, the paper's. With the pre-pass and the
    #: additions it is 1 in clean frames and 0 in others.
    omega_dropout: ClassVar[float] = 0.3
    #: Weight of the squared distance of the temporal weights from what the pre-pass says: any
    #: factor may move between omega and varphi, so that it need not be tuned.
    omega_weight: ClassVar[float] = 1.0


@dataclass(frozen=True, eq=False)
class Temporal:
    """Embedding and weight of B frames."""

    #: (B, width) temporal embedding z_l.
    z: Tensor
    #: (B,) temporal weight omega_l in (-1, 1).
    omega: Tensor


class DynamicPerturbation(nn.Module):
    """Delta g_l = omega_l * (varphi([z_l, g_l]) + F_l) for every frame of a clip.

    F, the field, is an addition to the paper.

    `psi` starts at zero, hence omega, hence every bias. `varphi` does not, so that psi gets a
    gradient at the first step and the others from the second: learning starts.

    Args:
        frame_count: L, the frames that have a temporal embedding, at least 1.
        width: of the embedding; 256 makes the paper's 75,323 parameters.
        rank: of the field that is added to varphi; 0: no field, as in the paper.
        poses: the largest correction of each number of a pose (rad) and of a translation (m) by
            the authors' pose head by time; None: no such head.

    Attributes:
        field: the field; None without.

    Raises:
        UsageError: `frame_count` or `width` is below 1, or `rank` below 0.

    Source: WildGHand, section "Dynamic Perturbation Disentanglement"; `docs/dpd_pao.md` lists
    what the paper leaves open. Initial weights are torch's, from its global generator.
    """

    encoding: Tensor

    def __init__(
        self,
        frame_count: int,
        width: int = 256,
        rank: int = 0,
        poses: tuple[float, float] | None = None,
    ) -> None:
        super().__init__()
        if frame_count < 1:
            raise UsageError(f"is {frame_count}", field="frame_count", remedy="Use 1 or more.")
        if width < 1:
            raise UsageError(f"is {width}", field="width", remedy="Use 1 or more.")
        self.phi = nn.Sequential(nn.Linear(ENCODED, width), nn.SiLU(), nn.Linear(width, width))
        self.psi = nn.Linear(width, 1)
        nn.init.zeros_(self.psi.weight)
        nn.init.zeros_(self.psi.bias)
        self.varphi = nn.ModuleDict({name: nn.Linear(width + k, k) for name, k in SIZES.items()})
        self.field = BiasField(rank, width) if rank else None
        self.pose_head: nn.Sequential | None = None
        if poses is not None:
            bounds = torch.tensor(poses).repeat_interleave(torch.tensor([48, 3]))
            self.register_buffer("bounds", bounds, persistent=False)
            last = nn.Linear(width, 51)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            self.pose_head = nn.Sequential(nn.Linear(51 + width, width), nn.SiLU(), last)
        # It follows from the number of frames, so checkpoints do not hold it.
        table = encode_frames(torch.arange(frame_count), frame_count)
        self.register_buffer("encoding", table, persistent=False)

    @property
    def frame_count(self) -> int:
        """L."""
        return len(self.encoding)

    def temporal(self, frames: Tensor) -> Temporal:
        """Embedding and weight of B frames.

        Args:
            frames: (B,) int, 0 to L - 1; frame 0 is the paper's l = 1.
        """
        # Off the CPU the check would wait for the device.
        known = frames.device.type != "cpu" or not frames.numel()
        if not known and not 0 <= int(frames.min()) <= int(frames.max()) < self.frame_count:
            raise UsageError(
                f"are {int(frames.min())} to {int(frames.max())}",
                field="frames",
                remedy=f"This module knows the frames 0 to {self.frame_count - 1}.",
            )
        z = self.phi(self.encoding[frames])
        return Temporal(z, 2.0 * torch.sigmoid(self.psi(z).squeeze(-1)) - 1.0)

    def move(self, pose: Tensor, transl: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Correct poses (B, 16, 3) and translations (B, 3) by the pose head."""
        if self.pose_head is None:
            return pose, transl
        seen = torch.cat((pose.flatten(1), transl, z), dim=-1)
        step = self.get_buffer("bounds") * torch.tanh(self.pose_head(seen))
        return pose + step[:, :48].unflatten(1, (16, 3)), transl + step[:, 48:]

    def sum_of_means(self, raw: Tensor, z: Tensor) -> Tensor:
        """(B,) the sum over attributes of the mean of varphi([z, g]), for (B, N, 14) g."""
        of_g, shift = self.layer(z)
        means = raw.mean(dim=1) @ of_g.mT + shift
        return torch.stack([m.mean(dim=-1) for m in means.split([*SIZES.values()], dim=-1)]).sum(0)

    def biases(
        self, raw: RawAttributes, z: Tensor, omega: Tensor, field: Tensor | None = None
    ) -> RawAttributes:
        """Delta g, to be added to the attributes before their activation.

        The linear layer on [z, g] is split into one on z, once for each frame, and one on g:
        the same function with the same parameters, at the cost of the second only.

        Args:
            raw: g: (B, N, k) each, or (N, k) where all frames share it.
            z: (B, width).
            omega: (B,).
            field: (B, N, 14) of `field`, added to varphi; None: nothing.

        Returns:
            (B, N, k) each.
        """
        own = cast(nn.Linear, self.varphi["offsets"]).weight.dtype
        for name, g in raw.items():
            if g.dtype != own:
                raise BadInput(
                    f"type is {g.dtype}, that of the module {own}",
                    field=f"raw.{name}",
                    remedy="Convert the attributes, or the module with `to(dtype)`.",
                )
        frames = {len(z), len(omega), *([len(raw.offsets)] if raw.offsets.ndim > 2 else [])}
        if len(frames) > 1 or raw.offsets.ndim > 3:
            raise ShapeMismatch(
                f"are {tuple(raw.offsets.shape)} (offsets), {tuple(z.shape)} and "
                f"{tuple(omega.shape)}",
                field="raw, z, omega",
            )
        made = {}
        local = {} if field is None else dict(RawAttributes.split(field).items())
        for name, g in raw.items():
            layer = cast(nn.Linear, self.varphi[name])
            of_z, of_g = layer.weight.split([z.shape[-1], g.shape[-1]], dim=1)
            shift = nn.functional.linear(z, of_z, layer.bias)
            value = g @ of_g.mT + shift[:, None]
            made[name] = omega[:, None, None] * (value + local.get(name, 0.0))
        return RawAttributes(**made)

    def layer(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """varphi as one linear layer on g: Delta g = omega (A g + c) for every frame.

        Args:
            z: (B, width).

        Returns:
            A (14, 14), a block for each attribute; c (B, 14).
        """
        layers = [cast(nn.Linear, self.varphi[name]) for name in SIZES]
        width = z.shape[-1]
        of_g = torch.block_diag(*(layer.weight[:, width:] for layer in layers))
        of_z = torch.cat([layer.weight[:, :width] for layer in layers])
        bias = torch.cat([layer.bias for layer in layers])
        return of_g, nn.functional.linear(z, of_z, bias)


@dataclass(frozen=True, eq=False)
class FramePerturbation:
    """The perturbation of one hand in B frames, for `wildghand.model.dress`."""

    #: Where the biases come from.
    module: DynamicPerturbation
    #: Embedding and weight of the frames.
    temporal: Temporal
    #: (B,) bool: frames that have biases in this step; None: all.
    kept: Tensor | None = None
    #: (B, N, 14) field of the module's at the Gaussians; None: no field.
    field: Tensor | None = None

    @property
    def omega(self) -> Tensor:
        """(B,) temporal weights; 0 in frames that have no biases."""
        omega = self.temporal.omega
        if self.kept is None:
            return omega
        return torch.where(self.kept.to(omega.device), omega, omega.new_zeros(()))

    def biases(self, raw: RawAttributes) -> RawAttributes:
        """(B, N, k) Delta g; 0 in frames that have none."""
        return self.module.biases(raw, self.temporal.z, self.omega, self.field)


def encode_frames(frames: Tensor, frame_count: int) -> Tensor:
    """l / L and the sines and cosines of its octaves.

    Args:
        frames: (B,) int, 0 to L - 1.
        frame_count: L.

    Returns:
        (B, 21) float32: sin(2^0 pi l/L), cos(2^0 pi l/L), ..., cos(2^9 pi l/L), l/L with
        l = frame + 1.

    Source: the paper's gamma(l) with K = 9; the raw value follows the authors' implementation.
    """
    # In float64: at the ninth octave float32 would lose four digits.
    place = (frames.double() + 1.0) / frame_count
    octaves = 2.0 ** torch.arange(OCTAVES + 1, dtype=torch.float64, device=frames.device)
    angles = math.pi * place[:, None] * octaves
    waves = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
    return torch.cat([waves, place[:, None]], dim=-1).float()


def draw_kept(probability: Tensor, generator: torch.Generator) -> Tensor:
    """Which of B frames keep their temporal weights in a step.

    Args:
        probability: (B,) in [0, 1] that a frame does not, on the CPU: the paper's is 0.3 for all;
            frames that are known to be perturbed may keep theirs, with 0.

    Returns:
        (B,) bool, where the generator is.
    """
    drawn = torch.rand(probability.shape, generator=generator, device=generator.device)
    return drawn >= probability.to(drawn.device)
