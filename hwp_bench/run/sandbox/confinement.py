"""How far a stranger's program is kept apart, as settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import UsageError

#: `auto` takes namespaces where the system allows them and says so where it does not; `required`
#: refuses to run without; `none` leaves the program its user's files and network.
MODES = ("auto", "required", "none")
#: Share of the machine's memory that a program may take unless told otherwise.
DEFAULT_MEMORY_SHARE = 0.9


@dataclass(frozen=True)
class Confinement:
    """What holds for a method's process besides its time limit."""

    #: One of `MODES`.
    mode: str = "auto"
    #: Most memory of all its processes together, bytes; None: nine tenths of the machine's.
    memory_limit: int | None = None
    #: Files and folders that it may read besides the system, Python, the toolkit, its own folder
    #: and its request, such as weights.
    exposed: tuple[Path, ...] = ()
    #: Folders that stay empty for it even where a folder that it may read contains them.
    hidden: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UsageError(f"{self.mode!r} is none of {', '.join(MODES)}", field="isolation")
        if self.memory_limit is not None and self.memory_limit <= 0:
            raise UsageError(f"{self.memory_limit} is not above 0", field="memory limit")

    @property
    def memory_bytes(self) -> int:
        """The limit in force, bytes."""
        if self.memory_limit is not None:
            return self.memory_limit
        import psutil

        return int(DEFAULT_MEMORY_SHARE * psutil.virtual_memory().total)
