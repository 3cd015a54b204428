"""Run an untrusted program: without network, away from other files, with limits, to the last child.

`confinement` says how far it is confined and what it finds; `supervise` starts and watches it.
`launch` runs in between, in a process of its own that imports nothing heavy, and builds the sandbox
with `syscalls`.
"""
