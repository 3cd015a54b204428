"""The posed mesh of the hand, in the mean colours that the training frames show."""

import numpy as np

from hwp_bench.hands.raster import draw_faces


class MyMethod:
    """Gives each vertex the mean colour of the pixels that show it."""

    def __init__(self, settings, seed):
        """Take the settings of the preset in method.toml, and the seed of all random numbers."""

    def fit(self, training, budget, report):
        """Return the avatar; `training` is a hwp_bench.methods.TrainingCapture."""
        surface = Surface(training)
        total, weight = np.zeros((surface.count, 3)), np.zeros((surface.count, 1))
        for frame in training.train:
            hands, camera = training.hand_poses(frame), training.camera(frame)
            covered, corners, weights = surface.draw(hands, camera)
            seen = training.mask(frame)[covered] > 127
            colours = training.frame(frame)[covered][seen] / 255
            for corner in range(3):
                share = weights[seen, corner, None]
                np.add.at(total, corners[seen, corner], share * colours)
                np.add.at(weight, corners[seen, corner], share)
        # Vertices that no frame shows get the mean colour of the others.
        mean = total.sum(axis=0) / max(weight.sum(), 1e-9)
        avatar = ColouredMesh(surface, np.where(weight > 1e-3, total / (weight + 1e-9), mean))
        report(0, avatar)
        return avatar


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
        """Take colours (V, 3) in [0, 1]."""
        self.surface, self.colours = surface, colours

    def render(self, hands, camera):
        """Draw hands, a `HandPose` by side: (H, W, 3) in [0, 1], sRGB colour over black."""
        image = np.zeros((camera.height, camera.width, 3))
        covered, corners, weights = self.surface.draw(hands, camera)
        image[covered] = (self.colours[corners] * weights[:, :, None]).sum(axis=1)
        return image
