"""Measures of the quality of results, by the source and by common practice."""
