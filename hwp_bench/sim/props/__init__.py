"""What stands in a scene besides hands: objects and backdrops."""
