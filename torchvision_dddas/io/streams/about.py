"""What the lines of a stream need to know of the run."""

from dataclasses import dataclass


@dataclass
class About:
    """What hardly changes from frame to frame.

    start_utc_s: seconds since 1970 at time_s = 0, NaN while no clock is known. A live run sets it with its first
    picture, and again when the machine's clock is set. clock: whether it will be known. geographic: whether targets get
    longitudes and latitudes. landmarks: their names. source: what the run is called in Cursor-on-Target events.
    """

    start_utc_s: float = float("nan")
    geographic: bool = False
    landmarks: tuple[str, ...] = ()
    source: str = "dddas"
    clock: bool = True
