"""What `vulture` takes for unused and is not: one name a line, with the reason.

`python -m vulture` reads `[tool.vulture]` in `pyproject.toml`, which names this file. A test
refuses an entry without a reason, and one that is not needed any more.
"""
