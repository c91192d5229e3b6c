"""How good results are: measures, data sets, studies."""
