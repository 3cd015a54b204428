"""A hand from a space of textures: principal components of painted people, and a light."""
