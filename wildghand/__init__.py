"""WildGHand: anti-perturbation Gaussian hand avatars, the reference method of HWP bench."""
