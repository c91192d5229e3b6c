"""A run: put together by `assemble...`, run over a clip by `Pipeline`."""

from torchvision_dddas.pipeline.assembly import (
    AerialInput,
    Assembly,
    assemble,
    assemble_files,
    assemble_mission,
    clip_notes,
    locator_facts,
    map_site,
    read_locator,
)
from torchvision_dddas.pipeline.pipeline import Clip, Pipeline

__all__ = [
    "AerialInput",
    "Assembly",
    "Clip",
    "Pipeline",
    "assemble",
    "assemble_files",
    "assemble_mission",
    "clip_notes",
    "locator_facts",
    "map_site",
    "read_locator",
]
