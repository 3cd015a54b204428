"""Hands without a person: landmarks, other anatomies, and rigs from files."""
