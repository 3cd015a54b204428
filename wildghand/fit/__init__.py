"""Fitting an avatar to a training capture."""
