"""Evaluate a method on captures: run, check, score, put on record."""
