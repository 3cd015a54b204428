"""The plain fit with a correction of the given pose in each training frame."""
