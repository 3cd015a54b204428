"""PAO, perturbation-aware optimization: weights of frames, regions and pixels."""
