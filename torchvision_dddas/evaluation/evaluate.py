"""Results against the truth, for one clip or many: per clip, pooled over the counts, and the mean over clips."""

from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import clip
from torchvision_dddas.evaluation.metrics.clip import How, score_clip
from torchvision_dddas.evaluation.metrics.registry import figures, mean, pooled
from torchvision_dddas.evaluation.metrics.truth import Ignoring, find_truth, load_truth


def evaluate(
    truth: Path,
    result: Path,
    first_frame: int | None = None,
    interval: int = 1,
    ignoring: Ignoring = "dropped",
) -> dict[str, Any]:
    """Score results: {"clips": {name: measures}, "pooled": measures, "mean": measures, "notes": [...]}.

    truth and result are one clip's (masks, boxes, tracks; a folder that dddas detect or dddas track wrote, or
    MOTChallenge text), or folders of clips by name. Measures come in registry.GROUPS. Raises InputError where
    the two do not fit together.
    """
    if interval < 1:
        raise InputError(f"interval must be at least 1 frame, got {interval}")
    how = How(interval, ignoring)
    notes: list[str] = []
    clips = {}
    for name, (true_place, found_place) in _pairs(truth, result, notes).items():
        clips[name] = score_clip(load_truth(true_place, first_frame), clip.load(found_place), how, notes)
    scored = {name: {"frames": clip.frames, **figures(clip.counts)} for name, clip in clips.items()}
    report = {"clips": scored, "notes": notes}
    if len(clips) > 1:
        report["pooled"] = figures(pooled([clip.counts for clip in clips.values()]))
        report["mean"] = mean(list(scored.values()))
    return report


def _pairs(truth: Path, result: Path, notes: list[str]) -> dict[str, tuple[Path, Path]]:
    """The clips to score by name: (truth, result)."""
    for place, what in ((truth, "truth"), (result, "result")):
        if not place.exists():
            raise InputError(f"no {what} at {place}")
    if find_truth(truth) is not None or clip.is_result(result):
        name = result.resolve()
        return {name.stem if result.is_file() else name.name: (truth, result)}
    names = sorted(p.name for p in truth.iterdir() if p.is_dir()) if truth.is_dir() else []
    places = {n: p for n in names for p in (result / f"{n}.txt", result / n) if clip.is_result(p)}
    pairs = {n: (truth / n, p) for n, p in places.items() if find_truth(truth / n) is not None}
    if not pairs:
        raise InputError(
            f"no clip to score: no folder in {truth} that holds masks, boxes or tracks has its like in {result} "
            f"with a {clip.DETECTIONS} or {clip.TRACKS}"
        )
    notes += [f"{n}: no result, not scored" for n in names if n not in places]
    notes += [f"{n}: no truth, not scored" for n in places if n not in pairs]
    return pairs
