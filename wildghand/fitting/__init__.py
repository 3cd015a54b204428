"""The fit of an avatar to a capture."""

from wildghand.fitting.session import fit_capture

__all__ = ["fit_capture"]
