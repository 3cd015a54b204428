"""The plain fit with a mask that learns late and from coarse to fine, as in RobustSplat."""
