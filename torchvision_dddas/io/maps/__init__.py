"""Maps of located targets: GeoJSON, KML, Cursor-on-Target, and a picture."""
