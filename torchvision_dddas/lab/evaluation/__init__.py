"""The quality of results: measures, data sets, studies."""
