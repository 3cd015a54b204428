"""The model that is fitted: network, perturbation biases, frame-wise corrections, and drawing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from wildghand.dpd.dpd import DynamicPerturbation, Perturbation, Temporal
from wildghand.dpd.field import bone_features
from wildghand.dpd.scale_gradients import scale_refinement
from wildghand.evidence import ColorChanges, Evidence
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.gaussians.training import TrainingClip
from wildghand.light import KnownLight
from wildghand.model.dress import Gaussians, dress
from wildghand.model.free_poses import dimmed, dressed, predict_hand
from wildghand.model.rasterize_hands import rasterize_hands
from wildghand.model.rendered import HandState, RenderedFrames, largest
from wildghand.model.wrist import WristWall
from wildghand.network import HandFeatures, NetworkOutput, PredictionNetwork
from wildghand.poses import ClipPoses
from wildghand.shadows import CastLight, HandShadows, ShadowSettings
from wildghand.shadows.hand_shadows import Hand, Hands
from wildghand.subject import SubjectShape


class WildGHandModel(nn.Module):
    """Gaussians of one or two hands, and what differs from frame to frame of the training clip.

    Args:
        rigs: by side; they carry the Gaussians.
        network: predicts the attributes.
        frame_count: R, training frames that are fitted.
        dpd: model perturbations as biases of the attributes.
        embedding: width of the temporal embedding.
        rank: of the field of biases; 0: none.
        template: apply the network's displacement of the template (head iii).
        shadows: how hands are drawn in the light that casts shadows, once there is one.

    Attributes:
        log_gains: (R, 3) log of the gain on the sRGB image of each frame.
        light: by which unknown normals are drawn in free poses; None: as the network says.
        evidence: by which free poses are drawn; None: as they were learnt.
        clip_poses: what is believed of the poses that the clip gives; None: what it gives.
        color_changes: of places that few frames have shown, in free poses; None: none.
        shadows: the hands in the light that casts shadows; None: the network alone says how bright
            skin is.
        pose_steps: (S, R, 16, 3) rad, added to the given poses of the hands in order.
        transl_steps: (S, R, 3) m, added to the given translations.
    """

    def __init__(
        self,
        rigs: Mapping[str, HandRig],
        network: PredictionNetwork,
        frame_count: int,
        *,
        dpd: bool = True,
        embedding: int = 256,
        rank: int = 0,
        template: bool = True,
        shadows: ShadowSettings | None = None,
    ) -> None:
        super().__init__()
        self._shadow_settings = shadows or ShadowSettings()
        self.shadows: HandShadows | None = None
        self._template = template
        self.light: KnownLight | None = None
        self.evidence: Evidence | None = None
        self.color_changes: ColorChanges | None = None
        self.clip_poses: ClipPoses | None = None
        self._walls: dict[str, WristWall] = {}
        self.rigs = dict(rigs)
        self.network = network
        self.perturbation = nn.ModuleDict(
            {side: DynamicPerturbation(frame_count, embedding, rank) for side in rigs}
            if dpd
            else {}
        )
        for side, rig in self.rigs.items() if dpd and rank else ():
            self.register_buffer(f"bones_{side}", bone_features(rig), persistent=False)
        self.log_gains = nn.Parameter(torch.zeros(frame_count, 3))
        self.pose_steps = nn.Parameter(torch.zeros(len(rigs), frame_count, 16, 3))
        self.transl_steps = nn.Parameter(torch.zeros(len(rigs), frame_count, 3))

    def keep(
        self, found: SubjectShape | ClipPoses | KnownLight | Evidence | ColorChanges | CastLight
    ) -> None:
        """Keep what was fitted next to the network, so that it is saved with it.

        Args:
            found: the person's shape, which the rigs have already, or what the model draws by from
                now on: see the attributes.
        """
        for name, values in found.to_tensors().items():
            self.register_buffer(name, values.to(self.log_gains.device))
        if isinstance(found, KnownLight):
            self.light = found.to(self.log_gains.device)
        if isinstance(found, Evidence):
            self.evidence = found.to(self.log_gains.device)
            walls = {side: WristWall.of(rig) for side, rig in self.rigs.items()}
            self._walls = {side: wall for side, wall in walls.items() if wall is not None}
        if isinstance(found, ClipPoses):
            self.clip_poses = found
        if isinstance(found, ColorChanges):
            self.color_changes = found
        if isinstance(found, CastLight):
            self.shadows = HandShadows(self.rigs, found, self._shadow_settings)

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        return all(bool(value.isfinite().all()) for value in self.parameters())

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state that the fit no longer changes."""
        return {name: value.detach().clone() for name, value in self.state_dict().items()}

    @property
    def biases(self) -> list[DynamicPerturbation]:
        """The perturbation modules of the hands; none while perturbations are not modelled."""
        return [self.biases_of(side) for side in self.perturbation]

    def biases_of(self, side: str) -> DynamicPerturbation:
        """The perturbation module of one hand."""
        module = self.perturbation[side]
        assert isinstance(module, DynamicPerturbation)
        return module

    def draw_frames(
        self,
        clip: TrainingClip,
        rows: Tensor,
        width: int,
        height: int,
        *,
        kept: Mapping[str, Tensor] | None = None,
        teach: Callable[[Tensor], Tensor | None] | None = None,
        move: bool = False,
        refine: bool = False,
        features: Mapping[str, HandFeatures] | None = None,
        dark: Mapping[str, Tensor] | None = None,
    ) -> RenderedFrames:
        """Draw training frames with everything that is particular to them.

        Args:
            clip: hands and cameras.
            rows: (B,) int64 positions among the training frames.
            width, height: px.
            kept: (B,) bool by side: False leaves a frame's biases out; None: never.
            teach: from (B,) temporal weights, before dropout and without gradient, to how much the
                canonical hand learns from each frame, (B,) in [0, 1], or None: all. None: all.
            move: add `pose_steps` and `transl_steps` to the given parameters.
            refine: apply the network's refinement of the parameters (head iv).
            features: of the network by side, where they are at hand already.
            dark: (B, N) factors of the hands' shadows by side, where they are at hand already.
        """
        if dark is None:
            hands = {side: _in_frames(clip.parameters[side], rows) for side in self.rigs}
            dark = self.cast(hands)
        temporal = {side: self.biases_of(side).temporal(rows) for side in self.perturbation}
        shares = None if teach is None else teach(self._largest_omega(temporal, rows))
        states, parts = {}, []
        for index, (side, rig) in enumerate(self.rigs.items()):
            anchors = clip.hand(side, rows)
            pose, betas, transl = clip.parameters[side]
            pose, transl = pose[rows], transl[rows]
            if move:
                pose = pose + self.pose_steps[index, rows]
                transl = transl + self.transl_steps[index, rows]
            prediction = self.predict(
                side, anchors, pose.detach(), None if features is None else features[side]
            )
            prediction = dimmed(prediction, dark.get(side))
            if refine:
                step = prediction.refinement
                if shares is not None:
                    step = scale_refinement(step, shares)
                pose, betas, transl = pose + step.pose, betas + step.betas, transl + step.transl
            if move or refine:
                anchors = rig.follow(pose, betas, transl)
            perturbation, omega = None, pose.new_zeros(len(rows))
            if side in self.perturbation:
                omega = temporal[side].omega
                perturbation = self.perturbation_in(
                    side, temporal[side], anchors, None if kept is None else kept[side]
                )
            gaussians, bias_size = dress(
                anchors, prediction, self.network.activation, perturbation, shares
            )
            parts.append(gaussians)
            states[side] = HandState(prediction, bias_size, omega, gaussians.opacities)
        image, coverage = rasterize_hands(parts, clip.viewmats[rows], clip.Ks[rows], width, height)
        # The image lies over black, so a gain on it is one on every Gaussian.
        image = image * self.log_gains[rows].exp()[:, None, None]
        return RenderedFrames(image, coverage, states)

    def _largest_omega(self, temporal: Mapping[str, Temporal], rows: Tensor) -> Tensor:
        """(B,) the temporal weight of largest magnitude among the hands, without gradient."""
        if not temporal:
            return self.log_gains.new_zeros(len(rows))
        return largest([hand.omega.detach() for hand in temporal.values()])

    def perturbation_in(
        self, side: str, temporal: Temporal, anchors: AnchorPoses, kept: Tensor | None
    ) -> Perturbation:
        """The perturbation of one hand in B frames, with its field where that can be seen."""
        module, field = self.biases_of(side), None
        # Off the CPU the question would wait for the device.
        unseen = kept is not None and kept.device.type == "cpu" and not bool(kept.any())
        if module.field is not None and not unseen:
            normals = quat_third_axis(anchors.orientations)
            field = module.field(temporal.z, self.get_buffer(f"bones_{side}"), normals)
        return Perturbation(module, temporal, kept, field)

    def draw(
        self,
        hands: Hands,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        refine: bool = False,
        features: Mapping[str, HandFeatures] | None = None,
        dark: Mapping[str, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Draw hands in any pose, free of what perturbed the training frames.

        With `evidence`, a wall closes the open end of the wrist, which no frame looks into.

        Args:
            hands: pose (B, 16, 3), betas (10,), transl (B, 3) by side.
            viewmats: (B, 4, 4).
            Ks: (B, 3, 3) px.
            width, height: px.
            refine: apply the network's refinement of the parameters (head iv).
            features: of the network by side, where they are at hand already.
            dark: (B, N) factors of the hands' shadows by side, where they are at hand already.

        Returns:
            (B, H, W, 3) sRGB over black and (B, H, W, 1) coverage.
        """
        dark = self.cast(hands) if dark is None else dark
        found = {
            side: self.gaussians(
                side,
                *hands[side],
                refine=refine,
                viewmats=viewmats,
                features=None if features is None else features[side],
                dark=dark.get(side),
            )
            for side in self.rigs
            if side in hands
        }
        return self.rasterize(found, viewmats, Ks, width, height)

    def rasterize(
        self,
        found: Mapping[str, tuple[Gaussians, Hand]],
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        """Draw hands and their walls.

        Args:
            found: by side, as `gaussians` returns them.
            viewmats, Ks, width, height: see `draw`.

        Returns:
            See `draw`.
        """
        parts = [made for made, _ in found.values()] + self.walls(found)
        return rasterize_hands(parts, viewmats, Ks, width, height)

    def wall(self, side: str) -> WristWall | None:
        """What closes the wrist of one hand; None without evidence, or where it stays open."""
        if self.evidence is None or side in self.evidence.open_wrists:
            return None
        return self._walls.get(side)

    def walls(self, found: Mapping[str, tuple[Gaussians, Hand]]) -> list[Gaussians]:
        """Close the wrists of hands; none while there is no evidence.

        Args:
            found: by side, as `gaussians` returns them.
        """
        several = ((self.wall(side), *each) for side, each in found.items())
        return [wall.close(made, *hand) for wall, made, hand in several if wall is not None]

    def gaussians(
        self,
        side: str,
        pose: Tensor,
        betas: Tensor,
        transl: Tensor,
        *,
        refine: bool = False,
        viewmats: Tensor | None = None,
        rows: Tensor | None = None,
        features: HandFeatures | None = None,
        dark: Tensor | None = None,
    ) -> tuple[Gaussians, Hand]:
        """The Gaussians of one hand in any pose, free of perturbations unless frames are named.

        Args:
            side: which hand.
            pose: (B, 16, 3) axis-angle, rad.
            betas: (10,).
            transl: (B, 3) m.
            refine: apply the network's refinement of the parameters (head iv).
            viewmats: (B, 4, 4) of the cameras that look at them; with these, skin that faces them
                with a normal that no training frame has shown is drawn by the fitted light.
            rows: (B,) positions among the training frames, whose biases and gains are added.
            features: of the network, where they are at hand already.
            dark: (B, N) factors of the hands' shadows; None: of those that it casts on itself.

        Returns:
            The Gaussians, and the parameters that they are posed by: the given or the refined ones.
        """
        hand = pose, betas, transl
        if dark is None:
            dark = self.cast({side: hand}).get(side)
        predicted = predict_hand(self, side, hand, viewmats, features)
        return dressed(self, side, predicted, refine=refine, rows=rows, dark=dark)

    def shaded(self, prediction: NetworkOutput, normals: Tensor) -> NetworkOutput:
        """A prediction in the light that casts shadows, with nothing in its way."""
        if self.shadows is None:
            return prediction
        return dimmed(prediction, self.shadows.shading(normals))

    def cast(self, hands: Hands) -> dict[str, Tensor]:
        """Shadows of hands that stand together; empty where the model casts none.

        Args:
            hands: pose (B, 16, 3), betas (10,), transl (B, 3) by side.

        Returns:
            (B, N) factors on the colours by side, without gradient.
        """
        return {} if self.shadows is None else self.shadows.of(hands)

    def predict(
        self, side: str, anchors: AnchorPoses, pose: Tensor, features: HandFeatures | None = None
    ) -> NetworkOutput:
        """Predict the attributes of one hand in B frames.

        Args:
            side: which hand.
            anchors: in the frames.
            pose: (B, 16, 3) axis-angle, rad.
            features: of the network, where they are at hand already.
        """
        normals = quat_third_axis(anchors.orientations)
        made = self.shaded(self.network(side, normals, pose, features), normals)
        if self._template:
            return made
        return replace(made, template_offsets=torch.zeros_like(made.template_offsets))


def _in_frames(
    parameters: tuple[Tensor, Tensor, Tensor], rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The parameters of a hand in some frames of a clip."""
    pose, betas, transl = parameters
    return pose[rows], betas, transl[rows]
