"""The camera's sensor and video."""
