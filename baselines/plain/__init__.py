"""The plain baseline; `method.toml` is its entry."""
