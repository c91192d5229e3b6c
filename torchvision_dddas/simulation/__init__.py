"""Worlds whose truth is known: what the demo shows and what the tests measure against."""
