"""The plain fit under one light that casts shadows, in the manner of HARP."""
