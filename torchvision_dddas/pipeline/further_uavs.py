"""Further UAVs beside a clip. Each has its own clip and pipeline, and its places are fused with the others."""

import math
from pathlib import Path

from torchvision_dddas.config import Settings, parse_override, with_parameters
from torchvision_dddas.control import FurtherUav
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import check_table, read_for_clip
from torchvision_dddas.io.output import NONE_LOCATED
from torchvision_dddas.io.platform_files import Platform, read_aerial_platform
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.pipeline.assembly import AerialInput, Assembly, assemble_files
from torchvision_dddas.pipeline.pipeline import Pipeline
from torchvision_dddas.types import Source


def open_uav(path: str | Path, settings: Settings, backend: str) -> FurtherUav:
    """Open a further UAV by its file. settings: of the run. Raise InputError for bad files or without places."""
    file = read_aerial_platform(path)
    source = open_source(file.clip, rate_hz=file.rate_hz, full_scale=_own(file, settings).levels.given)
    table = None if file.detections is None else read_for_clip(file.detections, None, source)
    notes = [] if table is None else check_table(table, file.interval, source)
    ready = prepare_uav(file, settings, source, backend)
    notes += ready.notes
    pipeline = Pipeline.from_assembly(ready, interval=file.interval, pictures=False, detector=table)
    site = ready.watch.locator.site if ready.watch is not None else None
    assert site is not None
    start_utc_s = math.nan if site.telemetry is None else site.telemetry.start_utc_s
    return FurtherUav(file, pipeline(source), site.origin_deg, start_utc_s, lambda: [*notes, *pipeline.notes])


def prepare_uav(file: Platform, settings: Settings, source: Source, backend: str) -> Assembly:
    """Assemble the parts that locate the targets of a UAV's pictures. Raise InputError as `open_uav` does."""
    telemetry = file.beside.get("telemetry")
    ready = assemble_files(AerialInput(**file.beside), telemetry, _own(file, settings), source, backend, file.clip)
    if ready.watch is None:
        reason = ready.notes[-1].removeprefix(NONE_LOCATED)
        raise InputError(f"{file.name} locates nothing: {reason}; `dddas views` shares identities without places")
    return ready


def _own(file: Platform, settings: Settings) -> Settings:
    # These two parameters belong to the run's own clip and log.
    changes = {"difference.ignore": "", "aerial.clock_offset_s": 0.0} | dict(map(parse_override, file.overrides))
    return with_parameters(settings, changes, f"platform {file.files[0]}")
