"""Baselines of HWP bench: one method directory each."""
