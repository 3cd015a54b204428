"""The prior over subjects that a fit starts from."""
