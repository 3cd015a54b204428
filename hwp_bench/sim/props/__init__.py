"""Objects that hands hold, backdrops, and what moves before them."""
