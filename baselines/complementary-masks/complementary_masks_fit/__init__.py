"""The plain fit under a hard and a soft mask in turn, held to its own average, as in AsymGS."""
