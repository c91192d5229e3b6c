"""What `dddas run` needs beside the pictures, read and checked before the first of them: the same live and not."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torchvision_dddas.cli.aerial import AerialInput, locator_for

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.detection.engine import Engine
    from torchvision_dddas.geo import Locator, Watch
    from torchvision_dddas.io.sources import Source
    from torchvision_dddas.types import Telemetry


@dataclass(frozen=True)
class Prepared:
    """settings: with the camera's focal length, where that is known. watch: None where nothing is located.

    flight: None without telemetry. notes: what the user should know.
    """

    settings: "Settings"
    engine: "Engine"
    watch: "Watch | None"
    flight: "Telemetry | None"
    notes: list[str]


def prepared(
    given: AerialInput | None,
    telemetry: Path | None,
    settings: "Settings",
    source: "Source",
    backend: str,
    clip: str,
) -> Prepared:
    """Read what is given beside a clip. given: None where nothing is located. Raises InputError for bad input."""
    from torchvision_dddas.detection.engine import load_engine
    from torchvision_dddas.io.telemetry import read_telemetry

    watch, notes = (None, []) if given is None else _watch(given, settings, source, backend)
    flight = None
    if watch is not None:
        flight = watch.locator.site.telemetry
        settings, more = _sized(settings, watch.locator)
        notes += more
    elif telemetry is not None:
        flight = read_telemetry(telemetry, settings.aerial.clock_offset_s, clip)
    return Prepared(settings, load_engine(backend, settings), watch, flight, notes)


def _watch(given: AerialInput, settings: "Settings", source: "Source", backend: str) -> "tuple[Watch, list[str]]":
    from torchvision_dddas.geo import Watch, check_colours
    from torchvision_dddas.geo.solvers import load_colours
    from torchvision_dddas.io.colour_files import read_colours

    colours = read_colours(given.colours) if given.colours is not None else None
    frames = None if source.count is None else (1, source.count)
    locator, notes = locator_for(
        given, settings, source.size, source.rate_hz, backend, frames, "clip", source.name, colours
    )
    helped = locator.site.telemetry is not None and settings.aerial.mode == "pose"
    check_colours(locator.site.landmarks, colours, helped)
    if colours is not None and (bare := [n for n in locator.site.landmarks.names if n not in colours.names]):
        notes.append(f"no colour is given for {', '.join(bare)}: not looked for in the pictures")
    return Watch(locator, colours, load_colours(backend) if colours is not None else None), notes


def _sized(settings: "Settings", locator: "Locator") -> "tuple[Settings, list[str]]":
    """With the camera's own focal length where targets' sizes are told from the altitude, unless another is set."""
    from torchvision_dddas.config import Settings, with_parameters

    focal = locator.camera.focal_px[0]
    if locator.site.telemetry is None or settings.gates.focal_px != Settings().gates.focal_px:
        return settings, []
    note = f"gates.focal_px is the camera's {focal:.0f} px, so that sizes in metres hold"
    return with_parameters(settings, {"gates.focal_px": focal}), [note]
