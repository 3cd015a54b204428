"""Light: its settings, points where rays meet surfaces, and shading."""
