"""A method that draws every frame in the mean colour of the hand. Replace `fit` and `render`."""

import numpy as np


class MyMethod:
    """Fits an avatar to the training frames of one capture."""

    def __init__(self, settings, seed):
        """Take the settings of the preset in method.toml, and the seed of all random numbers."""

    def fit(self, training, budget, report):
        """Return the avatar; `training` is a hwp_bench.methods.TrainingCapture."""
        pixels = [training.frame(f)[training.mask(f) > 127] for f in training.train]
        avatar = MeanColour(np.concatenate(pixels).mean(axis=0) / 255)
        # A fit in steps reports each of them: the curve of its score is made of that.
        report(0, avatar)
        return avatar


class MeanColour:
    """An avatar of one colour."""

    def __init__(self, colour):
        """Take a colour in [0, 1]."""
        self.colour = colour

    def render(self, hands, camera):
        """Draw hands, a `HandPose` by side: (H, W, 3) in [0, 1], sRGB colour over black."""
        return np.broadcast_to(self.colour, (camera.height, camera.width, 3))
