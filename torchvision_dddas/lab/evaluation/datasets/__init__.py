"""Data sets as they lie on disk, each read into one record: `Clip`. Nothing is downloaded."""
