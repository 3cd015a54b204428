"""The report: one self-contained HTML page about some results."""
