"""The official HWP release: folder names, frame records, crop, hands, capture."""

from hwp_bench.importers.official.from_release import OfficialImport, import_official

__all__ = ["OfficialImport", "import_official"]
