"""What runs write: recorders of output folders, run.json, log.txt, tables, maps and reports."""
