"""Ablations: variants of a method, the effect of its components, and their cost."""
