"""Clips with results drawn in."""
