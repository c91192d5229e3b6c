"""Read and write files: video, telemetry, tables, maps, overlays, streams, reports.

Other rooms use:
`sources` (`open_source` for clips; live streams), `images.decode_image`;
`telemetry.read_telemetry`, `elevation.read_elevation` and `read_ortho`;
`detection_tables`, `foreign_boxes`, `ground_tables`, `camera_files`, `colour_files`, `zone_files`;
`tables`, `track_files.write_tracks`, `drawing.draw`;
`output` (recorders and records of runs), `streams.open_streams`, `report`, `overlay`, `overlay_video`, `maps`;
`atomic_files` (writing a file completely or not at all).
"""
