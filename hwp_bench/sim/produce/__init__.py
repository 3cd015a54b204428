"""From scenes to captures, previews and calibrated strengths."""
