"""Live views in a browser: an avatar that is posed, and a fit while it runs."""
