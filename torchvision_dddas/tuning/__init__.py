"""Tuning of parameters by gradient: examples of what is true, losses on them, descent, and what it was worth."""
