"""Shared foundations: errors, files, locks, records, images, tables, drawing, progress."""
