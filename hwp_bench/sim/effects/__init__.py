"""Effects: what each of the four perturbations and the sensor changes, and the plan of a frame."""
