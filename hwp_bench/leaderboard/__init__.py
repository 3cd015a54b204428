"""The leaderboard: entries of measured results, the paper's published numbers, the site."""
