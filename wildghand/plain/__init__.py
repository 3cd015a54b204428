"""The plain fit: anchored Gaussians, and a loop with a hook for all that a method may change."""
