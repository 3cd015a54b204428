"""Several results together: `statistics` (how sure a difference is) and `cost` (accuracy, time)."""
