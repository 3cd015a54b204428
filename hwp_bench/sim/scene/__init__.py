"""Scenes as checked data, and what follows from them at any time: hands and camera."""
