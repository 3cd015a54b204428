"""A prior over subjects: the weights that a fit starts from in place of random ones."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import atomic_folder, inside, read_json, refuse_other, write_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import Count, Seed, parse_record
from hwp_bench.capture.schema import HandModelId
from hwp_bench.hands import load_template
from wildghand.model.settings import WildGHandSettings
from wildghand.network import NetworkSettings, PredictionNetwork, network_settings
from wildghand.network.network import MAPS, shapes_of, shapes_of_settings


@dataclass(frozen=True)
class PriorRecord:
    """Description of a prior, and how it was made."""

    #: Version of the folder.
    schema: str
    #: `name`, `digest` and `source` of the hand model.
    hand_model: dict[str, str]
    #: Hands that have an identity map.
    sides: list[str]
    #: `wildghand.network.NetworkSettings` of its network.
    network: dict[str, Any]
    #: The captures that it was fitted to: `id`, `digest`, `hands` and `source` of each capture.
    captures: list[dict[str, Any]]
    #: All settings of that fit.
    settings: dict[str, Any]
    #: Its seed.
    seed: Seed
    #: Its optimizer steps.
    steps: Count
    #: SHA-256 of the file of weights, hex.
    weights: str


@dataclass(frozen=True, eq=False)
class Prior:
    """A prior, checked."""

    record: PriorRecord
    #: A network's state: shared weights, and the mean identity map of each hand that was seen.
    tensors: Mapping[str, Tensor]

    def initialise(self, network: PredictionNetwork) -> None:
        """Replace a network's weights by the prior's.

        A hand that the prior has not seen starts from the other hand's map: the two halves of
        the atlas hold the same skin at the same places.
        """
        state = dict(self.tensors)
        maps = {side: state.pop(f"{MAPS}{side}") for side in self.record.sides}
        for side in network.identity.maps:
            state[f"{MAPS}{side}"] = maps.get(side, next(iter(maps.values())))
        network.load_state_dict(state, strict=True)


def mean_weights(networks: Iterable[PredictionNetwork]) -> dict[str, Tensor]:
    """Weights that networks of several subjects with shared branches and heads have in common."""
    shared: dict[str, Tensor] = {}
    maps: dict[str, list[Tensor]] = {}
    for network in networks:
        for name, value in network.state_dict().items():
            value = value.detach().float().cpu()
            if name.startswith(MAPS):
                maps.setdefault(name, []).append(value)
            else:
                shared[name] = value
    return {**shared, **{name: torch.stack(values).mean(dim=0) for name, values in maps.items()}}


def check_tensors(
    tensors: Mapping[str, Tensor], sides: Iterable[str], shapes: Mapping[str, torch.Size]
) -> None:
    """Refuse tensors that are not the weights of a network."""
    absent = {f"{MAPS}{side}" for side in ("right", "left") if side not in sides}
    expected = {name: shape for name, shape in shapes.items() if name not in absent}
    for name in sorted(expected.keys() ^ tensors.keys()):
        raise BadInput("is missing" if name in expected else "is not known", field=name[:100])
    for name, value in tensors.items():
        if value.shape != expected[name]:
            raise BadInput(
                f"is {tuple(value.shape)}, not {tuple(expected[name])}"[:200], field=name
            )
        if not value.is_floating_point():
            raise BadInput(f"holds {value.dtype}, not floating point", field=name)
        if not bool(value.isfinite().all()):
            raise BadInput("holds NaN or infinity", field=name)


#: Version of the folder.
SCHEMA = "wildghand-prior/1"
#: Names of its files.
DESCRIPTION = "prior.json"
WEIGHTS = "weights.safetensors"
#: Largest file of weights that is read, bytes; the `paper` network has about 150 MB of them.
MAX_BYTES = 512 << 20

#: The value of the setting that stands for the prior of this package, and where that lies.
SHIPPED = "shipped"
_SHIPPED_FOLDER = "priors/compact"

_SIDES = ("right", "left")


class OtherKind(BadInput):
    """A prior is sound but of another kind than the fit."""


def choose_prior(
    settings: WildGHandSettings, hand_model: HandModelId, network: PredictionNetwork | None = None
) -> Prior | None:
    """Return the prior that a fit starts from, or None for random weights.

    A prior that a person names has to be of the fit's kind. The one that ships is taken where it
    is: nobody asked for it who chose another network or hand model.
    """
    if not settings.prior:
        return None
    shipped = settings.prior == SHIPPED
    root = find_prior(_SHIPPED_FOLDER if shipped else settings.prior)
    try:
        return load_prior(root, settings.network.build(), hand_model, network)
    except OtherKind:
        if shipped:
            return None
        raise


def find_prior(text: str) -> Path:
    """Return the folder that the setting `prior` names.

    A method's preset names it with a path inside the package, which it may not leave; a person
    names it with an absolute one.
    """
    remedy = (
        "Give the absolute path of a folder that `wildghand pretrain` made, and show it to an "
        "isolated method with --expose."
    )
    try:
        path = Path(text)
        if not path.is_absolute():
            path = inside(PACKAGES / "wildghand", text)
        found = (path / DESCRIPTION).is_file()
    except (BadInput, OSError, ValueError) as error:
        problem = str(error).splitlines()[0][:300]
        raise BadInput(f"is not a prior ({problem})", field="prior", remedy=remedy) from error
    if not found:
        raise BadInput(
            f"is not a prior: it has no {DESCRIPTION}", where=path, field="prior", remedy=remedy
        )
    return path


def refuse_no_prior(path: str | os.PathLike[str]) -> None:
    """Refuse the place of a prior where something else is."""
    refuse_other(path, "a prior", lambda folder: (folder / DESCRIPTION).is_file())


def save_prior(
    path: str | os.PathLike[str],
    tensors: Mapping[str, Tensor],
    *,
    hand_model: HandModelId,
    captures: Sequence[Mapping[str, Any]],
    settings: WildGHandSettings,
    seed: int,
    steps: int,
    overwrite: bool = False,
) -> Prior:
    """Write a prior, whole or not at all."""
    from safetensors.torch import save

    halves = {name: value.detach().half().contiguous() for name, value in tensors.items()}
    sides = [side for side in _SIDES if f"{MAPS}{side}" in tensors]
    check_tensors(halves, sides, shapes_of_settings(settings.network.build()))
    data = save(halves)
    record = PriorRecord(
        schema=SCHEMA,
        hand_model=dataclasses.asdict(hand_model),
        sides=sides,
        network=settings.network.build().to_json(),
        captures=[dict(capture) for capture in captures],
        settings=dataclasses.asdict(settings),
        seed=seed,
        steps=steps,
        weights=hashlib.sha256(data).hexdigest(),
    )
    refuse_no_prior(path)
    with atomic_folder(path, overwrite=overwrite, flag="--overwrite") as folder:
        (folder / WEIGHTS).write_bytes(data)
        write_json(folder / DESCRIPTION, dataclasses.asdict(record))
    return Prior(record, {name: value.float() for name, value in halves.items()})


def load_prior(
    path: str | os.PathLike[str],
    settings: NetworkSettings,
    hand_model: HandModelId,
    network: PredictionNetwork | None = None,
) -> Prior:
    """Read a prior; nothing in it is executed."""
    root, where = Path(path), str(Path(path) / DESCRIPTION)
    record = parse_record(PriorRecord, read_json(where), where=where, error=BadInput)
    _check_record(record, where)
    _check_fit(record, settings, hand_model, where)
    shapes = shapes_of_settings(settings) if network is None else shapes_of(network)
    return Prior(record, _read_weights(root / WEIGHTS, record, shapes))


def _check_record(record: PriorRecord, where: str) -> None:
    if record.schema != SCHEMA:
        problem = f"is {record.schema[:40]!r} where {SCHEMA!r} is read"
        raise BadInput(problem, where=where, field="schema")
    if not record.sides or record.sides != [side for side in _SIDES if side in record.sides]:
        raise BadInput(f"are {record.sides}"[:200], where=where, field="sides")
    try:
        network_settings(**record.network)
    except HwpError as error:
        raise BadInput(str(error), where=where) from error


def _check_fit(
    record: PriorRecord, network: NetworkSettings, hand_model: HandModelId, where: str
) -> None:
    """Refuse a prior that is sound but of another kind than the fit."""
    needed = network.to_json()
    for name, value in dataclasses.asdict(network_settings(**record.network)).items():
        # Opacities of either kind have the same weights.
        if value != needed[name] and name != "frame_opacities":
            raise OtherKind(
                f"was made with {name} = {value}, and this fit has {needed[name]}",
                where=where,
                field="network",
                remedy="Fit with the network settings of the prior, or without it.",
            )
    name = record.hand_model.get("name", "")
    if name != hand_model.name:
        raise OtherKind(
            f"was made with the hand model {name[:100]}, not {hand_model.name}",
            where=where,
            field="hand_model",
            remedy="Make one with `wildghand pretrain` on captures of this hand model.",
        )
    digest = record.hand_model.get("digest", "")
    if not _same_edition(digest, hand_model):
        raise OtherKind(
            f"was made with another edition of the hand model {hand_model.name} "
            f"({digest[:12]}) than the capture ({hand_model.digest[:12]})",
            where=where,
            field="hand_model",
            remedy="Make one with `wildghand pretrain` on captures of this edition.",
        )


def _same_edition(digest: str, hand_model: HandModelId) -> bool:
    """Whether a digest and a capture's are of one edition of the hand model.

    Both state the digest of their first hand: that of the left one where there is no right one.
    """
    if digest == hand_model.digest:
        return True
    try:
        sides = {load_template(hand_model.source, side).digest for side in _SIDES}
    except HwpError:
        # A model that is not here: its captures cannot be fitted anyway.
        return False
    return {digest, hand_model.digest} <= sides


def _read_weights(
    file: Path, record: PriorRecord, shapes: Mapping[str, torch.Size]
) -> dict[str, torch.Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    if not file.is_file() or file.stat().st_size > MAX_BYTES:
        raise BadInput(f"is missing or larger than {MAX_BYTES} bytes", where=file)
    try:
        data = file.read_bytes()
        if hashlib.sha256(data).hexdigest() != record.weights:
            raise BadInput(f"is damaged: {DESCRIPTION} states another digest", where=file)
        tensors = load(data)
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        problem = str(error).splitlines()[0][:300] if str(error) else type(error).__name__
        raise BadInput(f"holds no weights ({problem})", where=file) from error
    try:
        check_tensors(tensors, record.sides, shapes)
    except BadInput as error:
        raise BadInput(f"does not hold this prior's weights: {error}", where=file) from error
    return {name: value.float() for name, value in tensors.items()}
