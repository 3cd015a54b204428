"""A scan of the hand: a mesh with displacements, a texture, and a network of its shadows."""
