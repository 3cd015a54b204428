"""The plain baseline: Gaussians anchored on the hand, fitted to every training frame alike."""
