"""What the loop needs of a source that can be steered, such as the simulator, or vehicles by radio."""

from collections.abc import Iterator
from typing import Any, Protocol

from torchvision_dddas.types import Camera, Colours, Command, Elevation, Frame, GroundPicture, Landmarks, Telemetry


class Begun:
    """A source whose first frame has been read, so that its vehicles have reported; otherwise it is as it was."""

    def __init__(self, source: "Instrument") -> None:
        self._source, self._frames = source, iter(source)
        self._first = next(self._frames, None)

    def __iter__(self) -> Iterator[Frame]:
        if self._first is not None:
            yield self._first
            self._first = None
        yield from self._frames

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)


class Instrument(Protocol):
    """A source of frames that flies where it is told to, and tells meanwhile what its vehicles report.

    camera: the aerial one. colours: of the landmarks. elevation: of the ground, in metres about origin_deg, longitude
    and latitude. sun_rad: azimuth and height of the sun, None where nobody knows. plate_m: height of the landmarks'
    colours above ground.
    """

    name: str
    count: int | None
    exact: bool
    rate_hz: float
    size: tuple[int, int]
    last: int
    camera: Camera
    colours: Colours
    elevation: Elevation
    origin_deg: tuple[float, float]
    sun_rad: tuple[float, float] | None
    plate_m: float

    def __iter__(self) -> Iterator[Frame]: ...

    def steer(self, command: Command) -> None:
        """Do as told from the next frame on; places in degrees."""

    def landmarks(self) -> Landmarks:
        """All that ground vehicles reported until now, in degrees."""

    def telemetry(self) -> Telemetry:
        """All that the aerial vehicle reported of itself until now, in degrees."""

    def pictures(self) -> list[GroundPicture]:
        """What ground vehicles saw since this was last asked."""
