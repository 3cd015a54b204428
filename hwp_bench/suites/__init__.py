"""Suites: lists of captures that can be made sure of, rendered from scenes or imported from clips.

`suite.py` knows both kinds, and what a result lacks of its suite; `real.py` the real clips.
"""
