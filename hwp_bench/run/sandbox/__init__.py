"""Run a stranger's program: without network, away from other files, with limits, to the last child.

`confinement` says what is wanted, `places` what the program may see, `supervise` starts it and
watches it. `launch` runs in between, in a process of its own, and imports nothing heavy.
"""
