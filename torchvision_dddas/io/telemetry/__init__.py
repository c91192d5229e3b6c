"""What the vehicle reports of itself, from whatever wrote it down, as one record.

Own tables, DJI's subtitles, MAVLink and PX4 logs, MISB ST 0601 inside MPEG-TS, NMEA 0183.
"""

from torchvision_dddas.io.telemetry.reading import read_telemetry

__all__ = ["read_telemetry"]
