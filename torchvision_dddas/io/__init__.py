"""Files in and out: video, telemetry, tables, maps, overlays, streams, reports.

Other rooms use:
`sources` (`open_source` for clips; live streams), `images.decode_image`;
`telemetry.read_telemetry`, `elevation.read_elevation` and `read_ortho`;
`detection_tables`, `ground_tables`, `camera_files`, `colour_files` (`read_...` and `check_...`), `tables` (schemas);
`output` (recorders and records of runs), `streams.open_streams`, `report`, `overlay`, `overlay_video`, `maps`;
`atomic_files` (writing whole files, or none).
"""
