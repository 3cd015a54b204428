"""Sealed suites: simulated captures whose seeds nobody knows who has not the organiser's secret."""

from hwp_bench.sealed.check import Checked, check_revealed
from hwp_bench.sealed.make import SealedSuite, make_suite
from hwp_bench.sealed.recipe import Recipe
from hwp_bench.sealed.reveal import reveal

__all__ = ["Checked", "Recipe", "SealedSuite", "check_revealed", "make_suite", "reveal"]
