"""What every method on anchored Gaussians shares: rig, attributes, losses, frames, schedule."""
