"""Numerical hard cases: what must hold where arithmetic is at its limits, and whether it does."""
