"""Studies: whole data sets are run and scored, in parallel and with a cache; their results compared and searched."""
