"""Captures from elsewhere: a video with tracked landmarks, the official release, InterHand2.6M."""
