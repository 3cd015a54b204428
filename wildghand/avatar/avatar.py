"""A fitted avatar: drawing it in any pose, also inside a notebook."""

from __future__ import annotations

import base64
import functools
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import write_json
from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.base.records import Count, Seconds
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import MAX_FRAMES, HandModelId, arrays_digest, hand_arrays
from hwp_bench.hands import load_template
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.studio import REST, Pose, Studio
from wildghand.gaussians.hand_avatar import HandAvatar, PosedHands
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.splat import rasterize
from wildghand.splat.threads import denormals_flushed

#: Frames of a turn, and milliseconds of each.
TURN_FRAMES, TURN_MS = 24, 100
#: Largest edge of an inline picture, px: it lies in the notebook's file.
MAX_EDGE = 2048
# Of WebP; a hand of 320 px turns in some 100 kB.
_QUALITY = 80


@dataclass(frozen=True)
class InlinePicture:
    """A picture that notebooks show where it is the value of a cell."""

    #: The encoded picture.
    data: bytes
    #: Its media type: `image/png` or `image/webp`.
    media: str
    #: Edge in the page, px.
    size: int
    #: Said in place of the picture where there are no pictures.
    text: str
    #: A page to show instead, whole HTML; None: there is no such page.
    page: str | None = None

    def __repr__(self) -> str:
        return f"InlinePicture({self.text})"

    def _repr_html_(self) -> str:
        """Return the picture as HTML that needs no other file."""
        if self.page is not None:
            source = _data_uri(self.page.encode(), "text/html")
            place = 'style="width:100%;height:540px;border:0"'
            return f'<iframe src="{source}" title="{self.text}" {place}></iframe>'
        source = _data_uri(self.data, self.media)
        return f'<img src="{source}" width="{self.size}" height="{self.size}" alt="{self.text}">'

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Return what a notebook stores: the picture where it knows its type, HTML, and text."""
        bundle: dict[str, Any] = {"text/html": self._repr_html_(), "text/plain": repr(self)}
        if self.media == "image/png" and self.page is None:
            # Notebooks store pictures as base64, and pages such as GitHub's show them.
            bundle["image/png"] = base64.b64encode(self.data).decode()
            del bundle["text/html"]
        return bundle


def encode(drawn: list[np.ndarray], background: tuple[int, int, int], text: str) -> InlinePicture:
    """Return one drawing over a colour, or several as a turn: an animated WebP image.

    Args:
        drawn: (H, W, 4) float each, as `WildGHandAvatar.render` gives them.
    """
    from PIL import Image

    frames = [Image.fromarray(over(rgba, background)) for rgba in drawn]
    buffer, media = io.BytesIO(), "image/png" if len(frames) == 1 else "image/webp"
    if len(frames) == 1:
        frames[0].save(buffer, format="PNG")
    else:
        turn = {"save_all": True, "append_images": frames[1:], "duration": TURN_MS, "loop": 0}
        frames[0].save(buffer, format="WEBP", quality=_QUALITY, **turn)
    return InlinePicture(buffer.getvalue(), media, frames[0].width, text)


def over(rgba: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    """Return a drawing (H, W, 4) in [0, 1], premultiplied, over a colour: (H, W, 3) uint8."""
    behind = (1.0 - rgba[..., 3:]) * (np.array(background, dtype=np.float32) / 255.0)
    return as_uint8(rgba[..., :3] + behind)


def check_edge(size: int) -> None:
    """Check the edge of an inline picture."""
    if not 16 <= size <= MAX_EDGE:
        raise UsageError(f"is {size}", field="size", remedy=f"Use 16 to {MAX_EDGE} px.")


def _data_uri(data: bytes, media: str) -> str:
    return f"data:{media};base64,{base64.b64encode(data).decode()}"


_Frame = Annotated[int, Meta(ge=0, lt=MAX_FRAMES)]
# A little more than what is possible, since numbers are rounded.
_Omega = Annotated[float, Meta(ge=-1.001, le=1.001)]
_Share = Annotated[float, Meta(ge=-0.001, le=1.001)]
_Weight = Annotated[float, Meta(ge=0.0, le=1e6)]
# A capture has no more frames, so that a fit has none.
_PER_FRAME = Meta(max_length=MAX_FRAMES)


@dataclass(frozen=True)
class FitRecord:
    """How an avatar was fitted."""

    #: Frames of the capture that were fitted.
    frames: Annotated[list[_Frame], _PER_FRAME] = field(default_factory=list)
    #: Temporal weight of each of them by side; empty without DPD.
    temporal: dict[str, Annotated[list[_Omega], _PER_FRAME]] = field(default_factory=dict)
    #: Probability that each is clean, as the pre-pass judged; empty without it.
    clean: Annotated[list[_Share], _PER_FRAME] = field(default_factory=list)
    #: Weight of each, as it judged; empty without it.
    frame_weights: Annotated[list[_Weight], _PER_FRAME] = field(default_factory=list)
    #: Optimizer steps.
    steps: Count = 0
    #: Steps behind the state that validation frames chose; None: behind the last one.
    chosen_steps: Count | None = None
    #: Seconds of fitting.
    seconds: Seconds = 0.0
    #: The avatar's origin, such as a capture's id.
    source: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PosedGaussians:
    """N Gaussians of an avatar in one pose, as arrays of float32."""

    #: (N, 3) m, world.
    means: np.ndarray
    #: (N, 4) of length 1, (w, x, y, z), world.
    quats: np.ndarray
    #: (N, 3) m, standard deviations along the axes of the quaternions.
    scales: np.ndarray
    #: (N,) in (0, 1).
    opacities: np.ndarray
    #: (N, 3) sRGB; a drawing is cut to [0, 1].
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"PosedGaussians({len(self)} Gaussians)"

    def require_finite(self) -> None:
        """Refuse Gaussians with a number that is NaN or infinite, before they are written."""
        for item in fields(self):
            bad = int((~np.isfinite(getattr(self, item.name))).sum())
            if bad:
                problem = f"hold {bad:,} numbers that are NaN or infinite"
                remedy = "The avatar is damaged, or a pose or scale is out of range"
                raise BadInput(problem, field=item.name, remedy=f"{remedy}; nothing is written.")


@denormals_flushed()
@torch.no_grad()
def splat(posed: PosedGaussians, camera: Camera, device: str = "cpu") -> np.ndarray:
    """Draw Gaussians as they are: (H, W, 4) float32, as `WildGHandAvatar.render` gives it."""
    given = (posed.means, posed.quats, posed.scales, posed.opacities, posed.colors)
    arrays = (*given, camera.viewmat[None], camera.K[None])
    means, quats, scales, opacities, colors, viewmats, Ks = (
        torch.as_tensor(each, dtype=torch.float32, device=device) for each in arrays
    )
    image, coverage, _ = rasterize(
        means, quats, scales, opacities, colors, viewmats, Ks, camera.width, camera.height
    )
    rgba = torch.cat((image, coverage), dim=-1)[0]
    return rgba.clamp(0.0, 1.0).nan_to_num(0.0).cpu().numpy()


class WildGHandAvatar(HandAvatar):
    """See `hwp_bench.methods.contract.Avatar`.

    Args:
        model: what is drawn; while a fit runs it may be the live one.
        settings: how it was fitted.
        hand_model: the hand model whose parameters it takes.
        betas: (10,) of each hand as it was fitted, by side.
        mean_color: (3,) sRGB that the fit started from.
        seed: of the anchors.
        record: what is remembered of the fit.
        weight_masks: gives pixel weights by frame of the capture, (H, W) uint8, to look at. It is
            called when they are first asked for, because a fit's seconds are not for pictures.
    """

    def __init__(
        self,
        model: WildGHandModel,
        settings: WildGHandSettings,
        hand_model: HandModelId,
        betas: Mapping[str, np.ndarray],
        mean_color: torch.Tensor,
        seed: int,
        record: FitRecord,
        weight_masks: Callable[[], Mapping[int, np.ndarray]] = dict,
    ) -> None:
        super().__init__(model.rigs, model.log_gains.device, record.steps)
        self.model = model
        self.settings = settings
        self.hand_model = hand_model
        self.betas = dict(betas)
        self.mean_color = mean_color
        self.seed = seed
        self.record = record
        self._weigh = weight_masks
        #: The folder that holds it; None until it is written or if it was not read from one.
        self.folder: Path | None = None

    def __repr__(self) -> str:
        hands, frames = " and ".join(self.sides), len(self.record.frames)
        return (
            f"WildGHandAvatar({hands} hand of {self.hand_model.name}, {self.settings.gaussians} "
            f"Gaussians each, {self.steps} steps on {frames} frames)"
        )

    def draw(
        self, hands: PosedHands, viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw the hands without what perturbed the training frames; see `HandAvatar.draw`."""
        return self.model.draw(hands, viewmats, Ks, width, height, refine=self.settings.heads)

    @functools.cached_property
    def studio(self) -> Studio:
        """The default places of the hands and a camera."""
        templates = {side: rig.template for side, rig in self.model.rigs.items()}
        return Studio(self.hand_model.source, templates, self.betas)

    def render(
        self,
        hands: Mapping[str, HandPose] | Pose = REST,
        camera: Camera | None = None,
        *,
        size: int = 512,
    ) -> np.ndarray:
        """Draw the hands in a pose.

        Args:
            hands: hands by side; or a pose in which every hand stands upright before the
                camera: the name of one (`fist`), angles in degrees (`{"index1 flexion": 60}`),
                or axis-angle vectors.
            camera: None: one that sees all of the hands at rest (`studio`).
            size: edge of the picture without a camera, px.

        Returns:
            (H, W, 4) float32 in [0, 1]: sRGB colour over black (premultiplied) and coverage.

        Raises:
            UsageError: no hand, one that was not fitted, or no pose.
        """
        if camera is None:
            check_edge(size)
            camera = self.studio.camera(size, size)
        return super().render(self._hands(hands), camera)

    def show(
        self,
        pose: Mapping[str, HandPose] | Pose | None = None,
        *,
        size: int = 320,
        background: tuple[int, int, int] = (255, 255, 255),
    ) -> InlinePicture:
        """Show the avatar in a notebook: in a pose, or from all around.

        `wildghand.page.show_page` shows a page on which it is turned and posed.

        Args:
            pose: as `render` takes it; None: a turn at rest.
            size: edge, px.
            background: sRGB, 0 to 255.

        Raises:
            UsageError: not a pose, or a size out of range.
        """
        check_edge(size)
        turns = [360.0 * frame / TURN_FRAMES for frame in range(TURN_FRAMES)]
        poses = [self.studio.posed(REST, turn) for turn in turns] if pose is None else [pose]
        return encode([self.render(one, size=size) for one in poses], background, repr(self))

    def _hands(self, hands: Mapping[str, HandPose] | Pose) -> Mapping[str, HandPose]:
        """Hands as they are, or those that stand in the studio in a pose."""
        if isinstance(hands, Mapping):
            given = {side: hand for side, hand in hands.items() if isinstance(hand, HandPose)}
            if len(given) == len(hands):
                return given
            angles = {name: x for name, x in hands.items() if not isinstance(x, HandPose)}
            return self.studio.posed(angles)
        return self.studio.posed(hands)

    @property
    def gaussians(self) -> PosedGaussians:
        """The Gaussians in the rest pose of the hand model, one hand after the other."""
        return self.pose(self.rest_poses())

    def posed(self, hands: Mapping[str, HandPose]) -> PosedHands:
        """Return the hands as tensors; a pose of the clip is replaced by the corrected one."""
        return super().posed(self.believed(hands))

    def believed(self, hands: Mapping[str, HandPose]) -> dict[str, HandPose]:
        """The hands; a pose of the clip is replaced by the fit's corrected one.

        `render` and `pose` do this by themselves.
        """
        poses = self.model.clip_poses
        return dict(hands) if poses is None else poses.corrected(hands)

    def is_of(self, capture: Capture) -> bool:
        """Whether the avatar was fitted to a capture, and to this import of it."""
        source, frames = self.record.source, self.record.frames
        given = arrays_digest(hand_arrays(capture.hands))
        known = source.get("capture") in (None, capture.info.id)
        known = known and source.get("hands") in (None, given)
        return known and bool(frames) and max(frames) < len(capture)

    def believed_capture(self, capture: Capture) -> Capture:
        """The capture that was fitted; poses of its hands are replaced by the corrected ones."""
        poses = self.model.clip_poses
        if poses is None:
            return capture
        return replace(capture, hands=poses.corrected_clip(capture.hands))

    def rest_poses(self) -> dict[str, HandPose]:
        """Return every hand at rest; two hands lie side by side."""
        hands = {}
        for side in self.sides:
            shift = np.zeros(3)
            if len(self.sides) > 1:
                vertices = load_template(self.hand_model.source, side).vertices
                width = float(np.ptp(vertices[:, 2]))
                shift[2] = width if side == "right" else -width
            hands[side] = HandPose(side, np.zeros((16, 3)), self.betas[side], shift)
        return hands

    @denormals_flushed()
    @torch.no_grad()
    def pose(
        self,
        hands: Mapping[str, HandPose],
        *,
        closed: bool = False,
        viewmat: np.ndarray | None = None,
    ) -> PosedGaussians:
        """Pose the Gaussians of the given hands, one hand after the other.

        Args:
            hands: by side.
            closed: add the caps that close the open ends of the wrists in `render`.
            viewmat: (4, 4) world to camera, m: colours are those that `render` draws for this
                camera. None: those that the network gives, also where no frame has shown them.

        Raises:
            UsageError: no hand, or one that was not fitted.
        """
        refine, posed = self.settings.heads, self.posed(hands)
        dark = self.model.cast(posed)
        viewmats = None if viewmat is None else self._tensor(viewmat)[None]
        found = {
            side: self.model.gaussians(
                side,
                *given,
                refine=refine,
                viewmats=viewmats,
                dark=dark.get(side),
                all_around=True,
            )
            for side, given in posed.items()
        }
        parts = [made for made, _ in found.values()] + (self.model.walls(found) if closed else [])

        def array(name: str) -> np.ndarray:
            """Of one frame of each hand; tensors that all frames share have no frames."""
            tensors, axes = [getattr(part, name) for part in parts], 1 + (name != "opacities")
            frames = [tensor if tensor.ndim == axes else tensor[0] for tensor in tensors]
            return torch.cat(frames).cpu().numpy()

        return PosedGaussians(**{item.name: array(item.name) for item in fields(PosedGaussians)})

    @functools.cached_property
    def weight_masks(self) -> Mapping[int, np.ndarray]:
        """Pixel weights by frame of the capture, (H, W) uint8; empty where none are known."""
        masks, self._weigh = self._weigh(), dict  # The fit behind them is no longer held.
        return masks

    def write_diagnostics(self, folder: Path) -> None:
        """Write temporal weights and weight masks for the benchmark's tables and figures."""
        for side, weights in self.record.temporal.items():
            record = {"frames": self.record.frames, "weights": weights}
            write_json(folder / f"{side}-temporal.json", record)
        for frame, mask in self.weight_masks.items():
            write_image(folder / "weights" / f"{frame:06d}.png", mask)
