"""The hands of one person: surface, skin and sleeve."""
