"""Reveal the secret of a sealed suite, once its submissions are scored."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json, refuse_existing, write_json
from hwp_bench.base.records import Digest, parse_record, without_schema
from hwp_bench.publish import open_sealed
from hwp_bench.publish.parts import PUBLIC
from hwp_bench.sealed.files import KEEPER, MAX_FILE, PUBLICATION, SECRET, read_suite_page
from hwp_bench.sealed.secret import read_secret, secret_commitment

#: Version of a reveal.
SCHEMA = "hwp-revealed/1"


@dataclass(frozen=True)
class Revealed:
    """A revealed secret."""

    #: The secret, hex.
    secret: Digest
    #: The commitment of the page that it was made for.
    secret_commitment: Digest


def reveal(suite: str | os.PathLike[str], out: str | os.PathLike[str]) -> Revealed:
    """Write the file that reveals a suite's secret.

    Args:
        suite: folder of the suite, as `make_suite` made it.
        out: file to write, for everybody.

    Raises:
        UsageError: the file exists.
        BadInput: secret, page and sealed part do not belong together: what is revealed would
            convict the organiser.
    """
    folder = Path(suite)
    target = Path(out)
    refuse_existing(target)
    page = read_suite_page(folder / PUBLICATION / PUBLIC)
    secret = read_secret(folder / KEEPER / SECRET)
    if secret_commitment(secret, page.recipe.to_json()) != page.secret_commitment:
        raise BadInput(
            "is not the secret that the suite's page is committed to",
            where=folder / KEEPER / SECRET,
        )
    if open_sealed(folder / PUBLICATION).commitment != page.frames_commitment:
        raise BadInput(
            "is not the sealed part that the suite's page is committed to",
            where=folder / PUBLICATION,
        )
    found = Revealed(secret, page.secret_commitment)
    write_json(
        target,
        {
            "schema": SCHEMA,
            "secret": found.secret,
            "secret_commitment": found.secret_commitment,
        },
    )
    return found


def read_revealed(path: str | os.PathLike[str]) -> Revealed:
    """Read a revealed secret.

    Raises:
        BadInput: it is not one, or damaged.
    """
    value = read_json(path, max_bytes=MAX_FILE)
    value = without_schema(value, SCHEMA, where=path, error=BadInput)
    return parse_record(Revealed, value, where=path, error=BadInput)
