"""Captures from elsewhere: a video with tracked landmarks."""
