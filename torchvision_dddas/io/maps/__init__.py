"""Maps of located targets."""
