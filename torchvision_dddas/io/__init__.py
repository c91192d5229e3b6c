"""Files in and out: video, telemetry, tables, maps, overlays, streams, reports."""
