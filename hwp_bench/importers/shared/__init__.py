"""What imports share: landmarks, crop windows, overlays, writing."""
