"""The posed mesh of the hand; PyTorch fits the colours of its vertices, step by step.

For Gaussians in place of the mesh, `wildghand.splat.rasterize` has the arguments of gsplat's.
"""

import numpy as np
import torch

from hwp_bench.hands.raster import draw_faces


class MyMethod:
    """Fits the colours of the vertices by Adam."""

    def __init__(self, settings, seed):
        """Take the settings of the preset in method.toml, and the seed of all random numbers."""
        self.steps, self.rate = settings["steps"], settings["rate"]
        self.random = np.random.default_rng(seed)

    def fit(self, training, budget, report):
        """Return the avatar; `training` is a hwp_bench.methods.TrainingCapture."""
        surface = Surface(training)
        frames = [self.target(surface, training, frame) for frame in training.train]
        # Vertices that no frame shows keep the colour that all begin with.
        mean = torch.cat([wanted for _, _, wanted in frames]).mean(dim=0)
        colours = mean.repeat(surface.count, 1).requires_grad_()
        optimizer = torch.optim.Adam([colours], lr=self.rate)
        avatar = ColouredMesh(surface, colours)
        steps = budget.steps or self.steps
        for step in range(steps):
            # Checkpoints are made of what is reported; the clock stands still meanwhile.
            report(step, avatar)
            report.progress(step, steps)
            if budget.seconds is not None and report.elapsed >= budget.seconds:
                break
            corners, weights, wanted = frames[self.random.integers(len(frames))]
            drawn = (colours[corners] * weights[:, :, None]).sum(dim=1)
            loss = (drawn - wanted).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            avatar.steps = step + 1
        return avatar

    def target(self, surface, training, frame):
        """Return corners and weights of the pixels that show the hand, and their colours."""
        hands, camera = training.hand_poses(frame), training.camera(frame)
        covered, corners, weights = surface.draw(hands, camera)
        seen = training.mask(frame)[covered] > 127
        # One pixel at least, so that the mean of the loss is a number.
        seen[:1] |= not seen.any()
        colours = training.frame(frame)[covered][seen] / 255
        parts = (corners[seen], weights[seen].astype(np.float32), colours.astype(np.float32))
        return tuple(map(torch.from_numpy, parts))


class Surface:
    """The meshes of all hands of a capture."""

    def __init__(self, training):
        """Number the vertices of all hands through."""
        self.training, self.count, faces = training, 0, []
        for side in training.sides:
            template = training.template(side)
            faces.append(template.faces + self.count)
            self.count += len(template.vertices)
        self.faces = np.concatenate(faces)

    def draw(self, hands, camera):
        """Return the pixels that the hands cover (H, W), their vertices (P, 3) and weights."""
        posed = self.training.vertices(hands)
        points = np.concatenate([posed[side] for side in self.training.sides])
        points = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (points @ camera.K.T)[:, :2] / points[:, 2:]
        face, mix = draw_faces(pixels, points[:, 2], self.faces, (camera.height, camera.width))
        covered = face >= 0
        second, third = mix[covered].T
        weights = np.stack([1 - second - third, second, third], axis=1)
        return covered, self.faces[face[covered]], weights


class ColouredMesh:
    """An avatar: the mesh, and a colour for each vertex."""

    def __init__(self, surface, colours):
        """Take a tensor of colours (V, 3); while it is fitted it may leave [0, 1]."""
        self.surface, self.colours, self.steps = surface, colours, 0

    def render(self, hands, camera):
        """Draw hands, a `HandPose` by side: (H, W, 3) in [0, 1], sRGB colour over black."""
        image = np.zeros((camera.height, camera.width, 3))
        colours = self.colours.detach().numpy().clip(0, 1)
        covered, corners, weights = self.surface.draw(hands, camera)
        image[covered] = (colours[corners] * weights[:, :, None]).sum(axis=1)
        return image
