"""The plain fit behind occluders of each frame's own, in the manner of DeSplat."""
