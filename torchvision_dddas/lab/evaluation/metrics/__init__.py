"""How good results are, by the source's measures and the field's."""
