"""Shared by the importers: landmarks, crop windows, overlay sheets, writing captures."""
