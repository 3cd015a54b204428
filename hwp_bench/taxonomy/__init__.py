"""The perturbations of a hand video, the eleven captures of the paper, names of suites."""

from hwp_bench.taxonomy.catalogue import CatalogueEntry, catalogue
from hwp_bench.taxonomy.perturbations import (
    MAX_SEVERITY,
    PERTURBATIONS,
    Perturbation,
    check_severity,
    perturbation,
)
from hwp_bench.taxonomy.suites import SIZED_LIKE, SUITES

__all__ = [
    "MAX_SEVERITY",
    "PERTURBATIONS",
    "SIZED_LIKE",
    "SUITES",
    "CatalogueEntry",
    "Perturbation",
    "catalogue",
    "check_severity",
    "perturbation",
]
