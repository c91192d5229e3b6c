"""The report pages of runs."""
