"""Effects: what each of the four perturbations changes, and the plan of a frame."""
