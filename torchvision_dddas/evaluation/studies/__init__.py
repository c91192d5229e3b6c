"""Studies: many clips, their results and their measures; jobs that share the work, and a cache that keeps it."""
