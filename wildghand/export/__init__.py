"""Avatars as files for other programs: Gaussian splats and skinned meshes."""
