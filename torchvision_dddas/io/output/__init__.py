"""The output of runs: recorders of output folders, run.json, log.txt, tables, maps and reports."""

from torchvision_dddas.io.atomic_files import OutputPart
from torchvision_dddas.io.output.map_files import MapSite
from torchvision_dddas.io.output.recorder import PartOf, RunRecorder, parse_save
from torchvision_dddas.io.output.recorders import (
    AerialRecorder,
    ConfirmationRecorder,
    DetectionRecorder,
    GroundRecorder,
    PeopleRecorder,
    PipelineRecorder,
    TrackRecorder,
    ViewsRecorder,
)
from torchvision_dddas.io.output.run_record import (
    EVENTS,
    NONE_LOCATED,
    RESULTS,
    RUN_JSON,
    AdjustmentList,
    Event,
    RunRecord,
    SessionLog,
    clip_facts,
    describe_nothing_located,
    finite,
    make_session_folder,
    read_run_record,
    versions,
    without_numbers,
)
from torchvision_dddas.io.output.tables import CONFIRMATION_NAMES, confirmed_positions, fused_table
from torchvision_dddas.io.output.timelines import NOTICED, PROBLEM
from torchvision_dddas.io.output.zone_events import ZoneCounts

__all__ = [
    "CONFIRMATION_NAMES",
    "EVENTS",
    "NONE_LOCATED",
    "NOTICED",
    "PROBLEM",
    "RESULTS",
    "RUN_JSON",
    "AdjustmentList",
    "AerialRecorder",
    "ConfirmationRecorder",
    "DetectionRecorder",
    "Event",
    "GroundRecorder",
    "MapSite",
    "OutputPart",
    "PartOf",
    "PeopleRecorder",
    "PipelineRecorder",
    "RunRecord",
    "RunRecorder",
    "SessionLog",
    "TrackRecorder",
    "ViewsRecorder",
    "ZoneCounts",
    "clip_facts",
    "confirmed_positions",
    "describe_nothing_located",
    "finite",
    "fused_table",
    "make_session_folder",
    "parse_save",
    "read_run_record",
    "versions",
    "without_numbers",
]
