"""torch modules made of `functional`."""
