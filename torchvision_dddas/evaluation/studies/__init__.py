"""Studies: run and score whole data sets in parallel with a cache, compare the results, search parameters.

A study is read by `read_spec` and run by `run_study`; `summarize` has its measures. `output.write_study`, which runs a
study and writes its folder, is imported from its module, as it needs `evaluation.report`, which needs these records.
"""

from torchvision_dddas.evaluation.studies.comparison import LEVEL, compare_studies
from torchvision_dddas.evaluation.studies.goals import Goal, check_possible, goal_value, parse_goal
from torchvision_dddas.evaluation.studies.jobs import Event
from torchvision_dddas.evaluation.studies.results import (
    Case,
    Found,
    Results,
    Scored,
    ScoredCase,
    ScoredStudy,
    round_as_written,
)
from torchvision_dddas.evaluation.studies.runner import Plan, cache_folder, plan_study, run_jobs, run_study
from torchvision_dddas.evaluation.studies.scoring import score, whose_places
from torchvision_dddas.evaluation.studies.search_space import (
    Choice,
    Range,
    count_points,
    parse_grid,
    parse_ranges,
    why_impossible,
)
from torchvision_dddas.evaluation.studies.spec import TASKS, Spec, Task, read_spec
from torchvision_dddas.evaluation.studies.stages import find, open_clip, upstream_task
from torchvision_dddas.evaluation.studies.storage import Cache, read_scores
from torchvision_dddas.evaluation.studies.summary import measures, sum_costs, summarize
from torchvision_dddas.evaluation.studies.sweep import (
    StudyMeasure,
    SweepRecord,
    Trial,
    best,
    check_optuna,
    format_value,
    ranked,
    search_grid,
    search_ranges,
    settings_toml,
    split_clips,
    toml_value,
)
from torchvision_dddas.evaluation.studies.workers import Workers

__all__ = [
    "LEVEL",
    "TASKS",
    "Cache",
    "Case",
    "Choice",
    "Event",
    "Found",
    "Goal",
    "Plan",
    "Range",
    "Results",
    "Scored",
    "ScoredCase",
    "ScoredStudy",
    "Spec",
    "StudyMeasure",
    "SweepRecord",
    "Task",
    "Trial",
    "Workers",
    "best",
    "cache_folder",
    "check_optuna",
    "check_possible",
    "compare_studies",
    "count_points",
    "find",
    "format_value",
    "goal_value",
    "measures",
    "open_clip",
    "parse_goal",
    "parse_grid",
    "parse_ranges",
    "plan_study",
    "ranked",
    "read_scores",
    "read_spec",
    "round_as_written",
    "run_jobs",
    "run_study",
    "score",
    "search_grid",
    "search_ranges",
    "settings_toml",
    "split_clips",
    "sum_costs",
    "summarize",
    "toml_value",
    "upstream_task",
    "whose_places",
    "why_impossible",
]
