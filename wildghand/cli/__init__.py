"""The command line of the reference method."""
