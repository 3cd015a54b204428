"""From the plan of a frame to its images."""
