"""The command line: light parsers here, heavy imports only when a command runs."""
