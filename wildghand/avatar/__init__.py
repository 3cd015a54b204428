"""The fitted avatar: drawing, files, clips, export."""
