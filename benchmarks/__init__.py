"""Benchmarks of the toolkit. This comes before any of them loads torch: `hwp_bench` tells threads
how to wait."""

import hwp_bench  # noqa: F401
