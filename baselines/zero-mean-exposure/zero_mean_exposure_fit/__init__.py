"""The plain fit with exposures of zero mean and a controller of unseen frames, as in PPISP."""
