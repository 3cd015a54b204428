"""HWP bench: a benchmark for hand avatars learned from perturbed monocular video."""

__version__ = "0.1.0"
