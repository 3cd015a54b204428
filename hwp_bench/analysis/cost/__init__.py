"""Accuracy against time: curves of fits, what they say, and the Pareto front."""
