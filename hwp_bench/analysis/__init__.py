"""What results say together: `statistics` and `cost`."""
