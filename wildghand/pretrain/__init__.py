"""Fitting one network to captures of several subjects, for a prior."""
