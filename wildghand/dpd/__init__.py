"""DPD, dynamic perturbation disentanglement: temporally weighted biases of the attributes."""
