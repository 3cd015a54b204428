"""Meshes, surfaces, rays and noise, without knowledge of scenes."""
