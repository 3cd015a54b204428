"""The perturbations of a hand video, and the eleven captures of the paper."""

from hwp_bench.taxonomy.catalogue import CatalogueEntry, catalogue
from hwp_bench.taxonomy.perturbations import (
    MAX_SEVERITY,
    PERTURBATIONS,
    Perturbation,
    check_severity,
    perturbation,
)

__all__ = [
    "MAX_SEVERITY",
    "PERTURBATIONS",
    "CatalogueEntry",
    "Perturbation",
    "catalogue",
    "check_severity",
    "perturbation",
]
