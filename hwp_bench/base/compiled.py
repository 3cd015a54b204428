"""Functions that numba compiles to machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: compile a function on first use; the machine code is kept on disk where possible.

    Bounds are not checked, and a division by zero gives what NumPy gives.

    Args:
        options: further options of `numba.njit`, such as `nogil=True`.
    """
    settings = {"boundscheck": False, "error_model": "numpy", **options}

    def compile_function(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **settings)(function)
        except RuntimeError:  # numba found no folder to write to
            return numba.njit(**settings)(function)

    return compile_function
