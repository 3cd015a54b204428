"""Objects and backdrops of a scene."""
