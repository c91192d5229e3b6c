"""The floor of tables: from maps of pixels to targets. NumPy, SciPy and OpenCV; the same for every back end."""
