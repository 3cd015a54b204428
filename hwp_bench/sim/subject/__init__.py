"""Whose hands they are: surface, skin and sleeve."""
