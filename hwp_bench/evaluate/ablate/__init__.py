"""Ablations: which variants of a method are run, what its components buy, and what they cost."""
