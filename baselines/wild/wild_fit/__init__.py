"""The plain fit with an appearance and an uncertainty of each training frame."""
