"""Data sets on disk, each read into records of the class `Clip`. Nothing is downloaded."""
