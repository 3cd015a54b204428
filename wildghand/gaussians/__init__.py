"""Gaussians that follow a hand's surface, and what every method that fits them shares.

`rig` poses anchors on the hand; `attributes` are the Gaussians on them, before and after their
activation; `training` holds the frames and poses of a capture; `losses`, `perceptual` and
`regularizers` are terms of a loss; `fit_loop` has the parts of a fit's loop.
"""
