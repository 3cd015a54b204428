"""Options that several commands share, and what they stand for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.cli.options import add_json

if TYPE_CHECKING:
    from wildghand.avatar import WildGHandAvatar
    from wildghand.viewer.server import Address


def add_avatar(parser: argparse.ArgumentParser) -> None:
    """Add the avatar folder and `--hand-model`, which `avatar_of` reads."""
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )


def avatar_of(args: argparse.Namespace) -> WildGHandAvatar:
    """Return the avatar that `add_avatar` named."""
    from wildghand.avatar.files import load_avatar

    return load_avatar(args.avatar, hand=args.hand_model)


def add_poses(parser: argparse.ArgumentParser, what: str, **more: Any) -> None:
    """Add `--poses`, a capture."""
    parser.add_argument("--poses", type=Path, metavar="CAPTURE", help=what, **more)


def add_ending(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--overwrite` and `--json`."""
    parser.add_argument("--overwrite", action="store_true", help=f"replace an existing {what}")
    add_json(parser)


def add_fitting(parser: argparse.ArgumentParser, steps: str) -> None:
    """Add `--steps`, `--seed` and `--set`; `check_limits` checks the first two."""
    add = parser.add_argument
    add("--steps", type=int, help=steps)
    add("--seed", type=int, default=0, help="seed of all random numbers (default: 0)")
    text = "a setting, as schedule.batch=4 (wildghand/model/settings.py); may be repeated"
    add("--set", action="append", default=[], metavar="NAME=VALUE", help=text)


def add_address(parser: argparse.ArgumentParser) -> None:
    """Add `--host` and `--port`, which `address_of` reads."""
    add = parser.add_argument
    here = "address to serve at (default: 127.0.0.1, for this machine only)"
    add("--host", default="127.0.0.1", metavar="ADDRESS", help=here)
    add("--port", type=int, default=8080, help="port; the next free one if it is taken")


def address_of(args: argparse.Namespace) -> Address:
    """Return what `add_address` read."""
    from wildghand.viewer.server import Address

    return Address(args.host, args.port)
