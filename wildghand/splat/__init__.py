"""Gaussian splatting: one function, three backends."""

from wildghand.splat.api import rasterize

__all__ = ["rasterize"]
