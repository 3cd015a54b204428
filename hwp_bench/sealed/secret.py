"""The secret of a sealed suite: what is derived from it, and the digest that binds it.

Every number is HMAC-SHA256 under the secret, of a label that says what the number is for. So none
tells anything of another one or of the secret (RFC 2104; as the expand step of HKDF, RFC 5869).
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import canonical_json, read_json, write_json
from hwp_bench.base.records import MAX_SEED, Digest, parse_record, without_schema

#: Version of the secret's file, and of everything that is derived.
SCHEMA = "hwp-secret/1"
#: Length of a secret in bytes.
SECRET_BYTES = 32
#: Most bytes of the file.
_MAX_FILE = 10_000


@dataclass(frozen=True)
class _File:
    """The content of a secret's file: 32 bytes in hexadecimal digits."""

    secret: Digest


def draw_secret() -> str:
    """Return a new secret (hex) from the system's random numbers."""
    return secrets.token_hex(SECRET_BYTES)


def write_secret(path: str | os.PathLike[str], secret: str) -> None:
    """Write a secret to a file that only its owner may read."""
    place = Path(path)
    previous = os.umask(0o077)
    try:
        write_json(place, {"schema": SCHEMA, "secret": secret})
    finally:
        os.umask(previous)
    place.chmod(0o600)


def read_secret(path: str | os.PathLike[str]) -> str:
    """Return the secret (hex) of a file.

    Raises:
        BadInput: it is not one, or of another version.
    """
    value = without_schema(read_json(path, max_bytes=_MAX_FILE), SCHEMA, where=path, error=BadInput)
    return parse_record(_File, value, where=path, error=BadInput).secret


def derived(secret: str, *purpose: str) -> bytes:
    """Return the 32 bytes that a secret gives for one purpose.

    Args:
        secret: in hex.
        purpose: what they are for, such as `("seed", "capture0", "subject")`.
    """
    message = canonical_json([SCHEMA, *purpose]).encode()
    return hmac.new(bytes.fromhex(secret), message, hashlib.sha256).digest()


def derived_seed(secret: str, *purpose: str) -> int:
    """Return the seed of 63 bits that a secret gives for one purpose.

    With fewer bits all seeds could be tried: a person's shape, which methods are told, follows
    from one of them in microseconds.
    """
    return int.from_bytes(derived(secret, "seed", *purpose)[:8], "big") & MAX_SEED


def secret_commitment(secret: str, recipe: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) that binds an organiser to a secret and a recipe.

    The secret has 256 random bits, so that the digest tells nothing of it.

    Args:
        secret: in hex.
        recipe: JSON values of everything else that decides the captures.
    """
    text = canonical_json({"schema": SCHEMA, "secret": secret, "recipe": dict(recipe)})
    return hashlib.sha256(text.encode()).hexdigest()
