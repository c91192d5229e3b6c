"""Runs: `assemble` and its variants build the parts of a run, and `Pipeline` processes a clip."""

from torchvision_dddas.pipeline import advice
from torchvision_dddas.pipeline.assembly import (
    AerialInput,
    Assembly,
    assemble,
    assemble_files,
    assemble_mission,
    clip_notes,
    completion,
    locator_facts,
    map_site,
    note_uncovered,
    prepare_detection,
    read_locator,
)
from torchvision_dddas.pipeline.further_uavs import open_uav, prepare_uav
from torchvision_dddas.pipeline.own_detector import note_unused
from torchvision_dddas.pipeline.pipeline import ClipSource, Pipeline, find_scenes

__all__ = [
    "AerialInput",
    "Assembly",
    "ClipSource",
    "Pipeline",
    "advice",
    "assemble",
    "assemble_files",
    "assemble_mission",
    "clip_notes",
    "completion",
    "find_scenes",
    "locator_facts",
    "map_site",
    "note_uncovered",
    "note_unused",
    "open_uav",
    "prepare_detection",
    "prepare_uav",
    "read_locator",
]
