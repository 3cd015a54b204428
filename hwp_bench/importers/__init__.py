"""Captures from elsewhere: videos, the official release, InterHand2.6M, transforms.json."""
