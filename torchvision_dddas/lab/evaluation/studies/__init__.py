"""Studies: run and score whole data sets in parallel with a cache, compare the results, search parameters."""
