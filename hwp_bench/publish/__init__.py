"""Public and sealed parts of captures: what authors get, and what scores them."""

from hwp_bench.publish.parts import Publication, publish
from hwp_bench.publish.sealed import SealedPart, open_sealed

__all__ = ["Publication", "SealedPart", "open_sealed", "publish"]
