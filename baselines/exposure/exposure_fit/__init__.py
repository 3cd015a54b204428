"""The plain fit to frames that are means over a motion, in the manner of BAD-Gaussians."""
