"""The model that is fitted, and its settings."""
