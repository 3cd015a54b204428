"""Runs a method: its process, its walls (`sandbox`), and where jobs run (`engine`)."""
