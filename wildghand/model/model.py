"""The model that is fitted: network, perturbation biases, frame-wise corrections, and drawing.

A hand in free poses is drawn in two stages. The prediction by network and light comes first and
takes longest (`predict_hand`). What visibility, changes of colours, shadows and the refined pose
make of it comes second (`dressed`), so that it can be tried in several ways.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from hwp_bench.hands import HandTemplate, sample_surface
from wildghand.dpd.dpd import DynamicPerturbation, FramePerturbation, Temporal, bone_features
from wildghand.dpd.temporal import scale_refinement
from wildghand.gaussians.found import Found
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig, rig_of
from wildghand.gaussians.training import TrainingClip
from wildghand.light import CastLight, HandShadows, KnownLight
from wildghand.light.hand_shadows import Hand, Hands
from wildghand.model.dress import Gaussians, dress
from wildghand.model.frames import HandState, RenderedFrames, largest, rasterize_hands, relit
from wildghand.model.settings import WildGHandSettings
from wildghand.model.wrist import WristWall
from wildghand.network import (
    HandFeatures,
    NetworkOutput,
    PredictionNetwork,
    mirrored_anchors,
    surface_points,
)
from wildghand.poses import ClipPoses
from wildghand.subject import SubjectShape
from wildghand.visibility import ColorChanges, Visibility
from wildghand.visibility.count import facing_of

#: What a model may keep, the attribute that draws by it, and whether it says something of each
#: Gaussian. Another `Found` needs one line here.
FOUND: tuple[tuple[type[Found], str, bool], ...] = (
    (KnownLight, "light", False),
    (CastLight, "shadows", False),
    (ClipPoses, "clip_poses", False),
    (Visibility, "visibility", True),
    (ColorChanges, "color_changes", True),
)


@dataclass(frozen=True, eq=False)
class HandPrediction:
    """One hand in B free poses, after the first stage."""

    #: Pose (B, 16, 3), betas (10,) and translation (B, 3).
    hand: Hand
    #: In these poses.
    anchors: AnchorPoses
    #: Of the network, and of the light where the network knows no colours.
    prediction: NetworkOutput


class WildGHandModel(nn.Module):
    """Gaussians of one or two hands, and what differs from frame to frame of the training clip.

    Args:
        rigs: by side; they carry the Gaussians.
        network: predicts the attributes.
        frame_count: R, training frames that are fitted.
        dpd: model perturbations as biases of the attributes.
        embedding: width of the temporal embedding.
        rank: of the field of biases; 0: none.
        poses: the frames' poses are corrected by their temporal embedding.
        gains: each frame has a gain of its own on its colours.
        template: apply the network's displacement of the template (head iii).

    Attributes:
        log_gains: (R, 3) log of the gain on the sRGB image of each frame.
        light: for unknown normals in free poses; None keeps the network's colours.
        visibility: for free poses; None keeps the learnt Gaussians.
        clip_poses: corrected poses of the clip; None keeps the given ones.
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
        poses: bool = False,
        gains: bool = False,
        template: bool = True,
    ) -> None:
        super().__init__()
        self.shadows: HandShadows | None = None
        self._template = template
        self.light: KnownLight | None = None
        self.visibility: Visibility | None = None
        self.color_changes: ColorChanges | None = None
        self.clip_poses: ClipPoses | None = None
        self._walls: dict[str, WristWall] = {}
        self.rigs = dict(rigs)
        self.network = network
        bounds = (network.settings.max_pose, network.settings.max_transl) if poses else None
        self.perturbation = nn.ModuleDict(
            {side: DynamicPerturbation(frame_count, embedding, rank, bounds) for side in rigs}
            if dpd
            else {}
        )
        for side, rig in self.rigs.items() if dpd and rank else ():
            self.register_buffer(f"bones_{side}", bone_features(rig), persistent=False)
        # Without the additions of DPD nothing would hold them: the hand's colour would drift.
        self.log_gains = nn.Parameter(torch.zeros(frame_count, 3), requires_grad=gains)
        self.pose_steps = nn.Parameter(torch.zeros(len(rigs), frame_count, 16, 3))
        self.transl_steps = nn.Parameter(torch.zeros(len(rigs), frame_count, 3))

    def keep(self, found: Found) -> None:
        """Keep what was fitted next to the network, so that it is saved with it."""
        device = self.log_gains.device
        for name, values in found.to_tensors().items():
            self.register_buffer(name, values.to(device))
        held: Any = found.to(device)
        if isinstance(held, CastLight):
            held = HandShadows(self.rigs, held)
        if isinstance(held, Visibility):
            walls = {side: WristWall.of(rig) for side, rig in self.rigs.items()}
            self._walls = {side: wall for side, wall in walls.items() if wall is not None}
        for kind, attribute, _ in FOUND:
            if isinstance(found, kind):
                setattr(self, attribute, held)

    def keep_all(self, tensors: Mapping[str, Tensor], where: str) -> None:
        """Keep what an avatar holds next to its network."""
        counts = {side: len(rig) for side, rig in self.rigs.items()}
        for kind, _, of_gaussians in FOUND:
            sizes = {"N": counts} if of_gaussians else {}
            found = kind.from_tensors(tensors, where, **sizes)
            if found is not None:
                self.keep(found)

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
        move: Tensor | None = None,
        refine: bool = False,
        pose_head: bool = True,
        features: Mapping[str, HandFeatures] | None = None,
        dark: Mapping[str, Tensor] | None = None,
    ) -> RenderedFrames:
        """Draw training frames with everything that is particular to them.

        Args:
            rows: (B,) int64 positions among the training frames.
            width, height: px.
            kept: (B,) bool by side: False leaves a frame's biases out; None: never.
            teach: from (B,) temporal weights, before dropout and without gradient, to how much the
                canonical hand learns from each frame, (B,) in [0, 1], or None: all. None: all.
            move: (B,) bool, frames whose pose takes the frame's own step; None: none.
            refine: apply the network's refinement of the parameters (head iv).
            pose_head: with it, apply DPD's pose head by time too, where there is one.
            dark: (B, N) factors of the hands' shadows by side, where they are at hand already.
        """
        if dark is None:
            dark = self.cast(clip.given(rows))
        temporal = {side: self.biases_of(side).temporal(rows) for side in self.perturbation}
        shares = None
        if teach is not None:
            omegas = [hand.omega.detach() for hand in temporal.values()]
            shares = teach(largest(omegas) if omegas else self.log_gains.new_zeros(len(rows)))
        states, parts = {}, []
        for index, (side, rig) in enumerate(self.rigs.items()):
            anchors = clip.hand(side, rows)
            pose, betas, transl = clip.parameters[side]
            pose, transl = pose[rows], transl[rows]
            if move is not None:
                moved = move.to(pose)[:, None]
                pose = pose + moved[..., None] * self.pose_steps[index, rows]
                transl = transl + moved * self.transl_steps[index, rows]
            prediction = self.predict(
                side, anchors, pose.detach(), None if features is None else features[side]
            )
            prediction = dimmed(prediction, dark.get(side))
            if refine:
                step = prediction.refinement
                if shares is not None:
                    step = scale_refinement(step, shares)
                pose, betas, transl = pose + step.pose, betas + step.betas, transl + step.transl
                if pose_head and side in self.perturbation:
                    pose, transl = self.biases_of(side).move(pose, transl, temporal[side].z)
            if move is not None or refine:
                anchors = rig.follow(pose, betas, transl)
            perturbation, omega = None, pose.new_zeros(len(rows))
            if side in self.perturbation:
                perturbation = self.perturbation_in(
                    side, temporal[side], anchors, None if kept is None else kept[side]
                )
                omega = perturbation.omega
            gaussians, bias_size = dress(
                anchors, prediction, self.network.activation, perturbation, shares
            )
            parts.append(gaussians)
            states[side] = HandState(prediction, bias_size, omega, gaussians.opacities)
        image, coverage = rasterize_hands(parts, clip.viewmats[rows], clip.Ks[rows], width, height)
        # The image lies over black, so a gain on it is one on every Gaussian.
        image = image * self.log_gains[rows].exp()[:, None, None]
        return RenderedFrames(image, coverage, states)

    def perturbation_in(
        self, side: str, temporal: Temporal, anchors: AnchorPoses, kept: Tensor | None
    ) -> FramePerturbation:
        """The perturbation of one hand in B frames, with its field of biases where there is one."""
        module, field = self.biases_of(side), None
        # Off the CPU the question would wait for the device.
        unseen = kept is not None and kept.device.type == "cpu" and not bool(kept.any())
        if module.field is not None and not unseen:
            normals = quat_third_axis(anchors.orientations)
            field = module.field(temporal.z, self.get_buffer(f"bones_{side}"), normals)
        return FramePerturbation(module, temporal, kept, field)

    def draw(
        self,
        hands: Hands,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        refine: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw hands in any pose, free of what perturbed the training frames.

        With `visibility`, a cap closes the open end of the wrist, into which no frame looks.

        Args:
            hands: pose (B, 16, 3), betas (10,), transl (B, 3) by side.
            viewmats: (B, 4, 4).
            Ks: (B, 3, 3) px.
            width, height: px.
            refine: apply the network's refinement of the parameters (head iv).

        Returns:
            (B, H, W, 3) sRGB over black and (B, H, W, 1) coverage.
        """
        dark = self.cast(hands)
        found = {
            side: self.gaussians(
                side, *hands[side], refine=refine, viewmats=viewmats, dark=dark.get(side)
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
        """Draw hands and their caps."""
        parts = [made for made, _ in found.values()] + self.walls(found)
        return rasterize_hands(parts, viewmats, Ks, width, height)

    def wall(self, side: str) -> WristWall | None:
        """The cap of one hand's wrist; None without visibility, or where the wrist stays open."""
        if self.visibility is None or side in self.visibility.open_wrists:
            return None
        return self._walls.get(side)

    def walls(self, found: Mapping[str, tuple[Gaussians, Hand]]) -> list[Gaussians]:
        """Close the wrists of hands; none while there is no visibility."""
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
        dark: Tensor | None = None,
        all_around: bool = False,
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
            dark: (B, N) factors of the hands' shadows; None: of those that it casts on itself.
            all_around: the cameras say of the light alone, and the Gaussians are looked at from
                everywhere.
        """
        hand = pose, betas, transl
        if dark is None:
            dark = self.cast({side: hand}).get(side)
        predicted = self.predict_hand(side, hand, viewmats)
        eyes = None if all_around else viewmats
        return self.dressed(side, predicted, refine=refine, rows=rows, dark=dark, viewmats=eyes)

    def predict_hand(
        self,
        side: str,
        hand: Hand,
        viewmats: Tensor | None,
        features: HandFeatures | None = None,
    ) -> HandPrediction:
        """Predict one hand by network and light.

        Args:
            hand: pose (B, 16, 3), betas (10,) and translation (B, 3).
            viewmats: (B, 4, 4) of the cameras that look at it; None: the light says nothing.
        """
        pose = hand[0]
        anchors = self.rigs[side].pose(*hand)
        features = self.network.features(side) if features is None else features
        prediction = self.predict(side, anchors, pose, features)
        if self.light is not None and viewmats is not None:
            prediction = relit(
                prediction,
                self.light,
                lambda normals: self.shaded(self.network(side, normals, pose, features), normals),
                anchors,
                viewmats,
            )
        return HandPrediction(hand, anchors, prediction)

    def dressed(
        self,
        side: str,
        predicted: HandPrediction,
        *,
        refine: bool = False,
        rows: Tensor | None = None,
        dark: Tensor | None = None,
        viewmats: Tensor | None = None,
    ) -> tuple[Gaussians, Hand]:
        """The Gaussians of one hand.

        Args:
            viewmats: (B, 4, 4) of the cameras that look at it; None: from everywhere.
            rows: (B,) positions among the training frames, whose biases and gains are added; None:
                free of perturbations.
            dark: (B, N) factors of the hands' shadows; None: ones.
        """
        rig, anchors, prediction = self.rigs[side], predicted.anchors, predicted.prediction
        pose, betas, transl = predicted.hand
        behind = None
        if self.visibility is not None:
            bias = self.network.activation.log_scale_bias
            if viewmats is not None:
                behind = self.visibility.behind(side, facing_of(anchors, viewmats))
            settled = self.visibility.settle(side, prediction.raw, rig.spacing, bias, behind)
            prediction = replace(prediction, raw=settled)
        if self.color_changes is not None:
            colored = self.color_changes.color(side, prediction.raw, behind)
            prediction = replace(prediction, raw=colored)
        prediction = dimmed(prediction, dark)
        if refine:
            step = prediction.refinement
            pose, betas, transl = pose + step.pose, betas + step.betas, transl + step.transl
            anchors = rig.follow(pose, betas, transl)
        hand = pose, betas, transl
        if rows is None:
            made, _ = dress(anchors, prediction, self.network.activation)
            wall = self.wall(side)
            return (made if wall is None else wall.trim(made, *hand)), hand
        perturbation = None
        if side in self.perturbation:
            temporal = self.biases_of(side).temporal(rows)
            perturbation = self.perturbation_in(side, temporal, anchors, None)
        made = dress(anchors, prediction, self.network.activation, perturbation)[0]
        return replace(made, colors=made.colors * self.log_gains[rows].exp()[:, None]), hand

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
            pose: (B, 16, 3) axis-angle, rad.
        """
        normals = quat_third_axis(anchors.orientations)
        made = self.shaded(self.network(side, normals, pose, features), normals)
        if self._template:
            return made
        return replace(made, template_offsets=torch.zeros_like(made.template_offsets))


def dimmed(prediction: NetworkOutput, dark: Tensor | None) -> NetworkOutput:
    """A prediction whose colours are multiplied by (B, N) factors; None: as it is."""
    if dark is None:
        return prediction
    return replace(prediction, shadow=prediction.shadow * dark[..., None])


def make_model(
    templates: Mapping[str, HandTemplate],
    settings: WildGHandSettings,
    mean_color: torch.Tensor,
    frame_count: int,
    seed: int,
    device: torch.device,
    subject: SubjectShape | None = None,
) -> WildGHandModel:
    """Make the model that a fit starts from; the same arguments make the same model.

    Args:
        mean_color: (3,) sRGB in [0, 1] of the visible hand.
        subject: how the person's hand differs from the templates; None: not at all.
    """
    rigs = make_rigs(templates, settings.gaussians, seed, device, subject)
    surfaces = {
        side: surface_points(templates[side], rig.anchors, rig.spacing, mean_color)
        for side, rig in rigs.items()
    }
    network = PredictionNetwork(
        settings.network.build(), surfaces, seed, max_scale=settings.max_scale
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        dpd = settings.dpd
        model = WildGHandModel(
            rigs,
            network,
            frame_count,
            dpd=dpd.enabled,
            rank=dpd.rank if dpd.additions else 0,
            poses=dpd.poses,
            gains=dpd.enabled and dpd.additions,
            template=settings.heads,
        )
    if subject is not None:
        model.keep(subject)
    return model.to(device)


def make_rigs(
    templates: Mapping[str, HandTemplate],
    count: int,
    seed: int,
    device: torch.device,
    subject: SubjectShape | None = None,
) -> dict[str, HandRig]:
    """Spread anchors over one hand or two, at the same places of the skin.

    They are spread over the template, whatever the person's hand is: a prior knows these places.
    """
    rigs: dict[str, HandRig] = {}
    anchors = None
    for side, template in templates.items():
        # The left template is the right one's mirror image, face by face.
        anchors = (
            sample_surface(template, count, seed) if anchors is None else mirrored_anchors(anchors)
        )
        bent = template if subject is None else subject.applied(template)
        rigs[side] = rig_of(bent, anchors, device)
    return rigs
