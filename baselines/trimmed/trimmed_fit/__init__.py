"""The plain fit in which pixels with large errors are left out: trimmed robust losses."""
