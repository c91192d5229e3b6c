"""Two studies compared: what changed, whether it is beyond noise, and the page that says so."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.lab.evaluation.studies.scored_clips import found_of, masked, tracked, walk
from tests.pages import Page
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.studies.cache import SCORES, read_scores, write_scores
from torchvision_dddas.lab.evaluation.studies.comparison import (
    compare_methods,
    compare_studies,
    comparison_report,
    verdict,
)
from torchvision_dddas.lab.evaluation.studies.records import ScoredCase, ScoredStudy
from torchvision_dddas.lab.evaluation.studies.scoring import score


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    """Few samples: none of these properties needs many."""
    monkeypatch.setattr(bootstrap.effects, "__defaults__", (100, 300))


@pytest.fixture
def missing(tmp_path):
    """missing(name, share, clips) makes a study of which a share of the boxes is missed."""

    def make(name, share, clips=range(8)) -> ScoredStudy:
        cases = []
        for seed in clips:
            clip, _ = tracked(tmp_path / name / f"clip-{seed}", seed)
            found = found_of(walk(seed, 30, miss=share)[1], 33)
            cases.append(ScoredCase("tracking", clip.name, score(clip, "tracking", found)))
        return ScoredStudy(name, tuple(cases))

    return make


def of_tracks(one, two):
    return compare_studies(one, two)["tasks"]["tracking"]


def test_a_study_beside_itself_is_the_same(missing):
    one = missing("one", 0.2, range(3))
    found = of_tracks(one, one)
    assert (found["same"], found["clips"]) == (["clip-0", "clip-1", "clip-2"], {})
    assert {entry["says"] for entry in found["pooled"]["tracks"].values()} == {"the same"}


def test_a_loss_everywhere_is_worse_beyond_noise_and_other_noise_is_not(missing):
    one, two = missing("one", 0.05), missing("two", 0.6)
    found = of_tracks(one, two)
    mota = found["pooled"]["tracks"]["mota"]
    assert mota["says"] == "worse" and mota["change"] == mota["second"] - mota["first"] < 0
    assert mota["over_clips"]["p"] == pytest.approx(2 / 2**8)
    assert mota["over_clips"]["p"] < mota["over_clips"]["p_holm"] < 0.05
    assert mota["over_clips"]["interval"][0] < mota["change"] < mota["over_clips"]["interval"][1] < 0
    assert mota["effect_size"] < -2 and mota["clips_needed"] == 8  # fewer give no p below 0.05 for four measures
    assert len(found["clips"]) == 8
    turned = [ScoredStudy(study.name, study.cases[::-1]) for study in (one, two)]
    assert json.dumps(found) == json.dumps(of_tracks(*turned))
    pooled = of_tracks(one, missing("three", 0.06))["pooled"]["tracks"]
    assert {entry["says"] for entry in pooled.values()} <= {"within noise", "the same"}
    assert pooled["mota"]["over_clips"]["enough"]


def test_p_is_corrected_for_the_tests_of_all_methods(missing):
    studies = [missing(name, share, range(6)) for name, share in {"one": 0.05, "two": 0.3, "three": 0.1}.items()]
    pair = of_tracks(*studies[:2])["pooled"]["tracks"]["hota"]
    first, second = (one["tasks"]["tracking"]["pooled"]["tracks"]["hota"] for one in compare_methods(studies))
    assert first["over_clips"]["p"] == pair["over_clips"]["p"] and second["first"] == first["first"]
    assert first["over_clips"]["p_holm"] > pair["over_clips"]["p_holm"]
    assert first["clips_needed"] > pair["clips_needed"]


def test_few_clips_allow_no_verdict_or_one_on_themselves(missing):
    pooled = of_tracks(missing("one", 0.05, range(2)), missing("two", 0.7, range(2)))["pooled"]["tracks"]
    assert pooled["mota"]["over_clips"] is None and pooled["mota"]["says"] == "worse on these clips"
    assert pooled["hota"]["says"] == "too little to tell"  # of whole tracks, about which frames say nothing


def test_clips_of_one_study_alone_are_named_and_studies_without_a_common_clip_refused(missing):
    one, two = missing("one", 0.1, (0, 1)), missing("two", 0.2, (1, 2))
    assert compare_studies(one, two)["notes"] == [
        "clip-0, tracking: only in the first study, one",
        "clip-2, tracking: only in the second study, two",
    ]
    with pytest.raises(InputError, match=r"no clip of the same task .* the first has clip-0 \(tracking\), the second"):
        compare_studies(ScoredStudy("one", one.cases[:1]), ScoredStudy("two", two.cases[1:]))
    with pytest.raises(InputError, match="the second nothing"):
        compare_studies(one, ScoredStudy("two", ()))


def test_another_truth_or_other_frames_are_not_compared(missing, tmp_path):
    one, two = missing("one", 0.1, (0, 1)), missing("two", 0.2, (0, 1))
    clip, found = tracked(tmp_path / "more" / "clip", 0)
    tracks = clip.truth.tracks
    fewer = replace(clip, truth=replace(clip.truth, tracks=tracks.at(np.arange(1, len(tracks.frame)))))
    other = ScoredCase("tracking", "clip-0", score(fewer, "tracking", found))
    (note,) = compare_studies(one, ScoredStudy("two", (other, two.cases[1])))["notes"]
    assert "clip-0, tracking: its truth differs" in note
    short, found = tracked(tmp_path / "more" / "short", 0, 20)
    other = ScoredCase("tracking", "clip-0", score(short, "tracking", found))
    with pytest.raises(InputError, match="no clip can be compared; clip-0, tracking: other frames were scored"):
        compare_studies(ScoredStudy("one", one.cases[:1]), ScoredStudy("two", (other,)))


def test_less_is_better_where_it_is():
    entry = {"change": -0.1, "over_frames": {"p_holm": 0.01, "enough": True}}
    assert (verdict(entry, "log_average_miss_rate"), verdict(entry, "f")) == ("better", "worse")


def test_masks_are_compared_by_pixels_boxes_and_ranks(tmp_path):
    clip, found = masked(tmp_path / "clip")
    worse = found_of(walk(0, 12)[1][::2], 12, dict.fromkeys(found.masks, found.masks[1]), False)
    one, two = (ScoredStudy("", (ScoredCase("motion", "clip", score(clip, "motion", f)),)) for f in (found, worse))
    found = compare_studies(one, two)["tasks"]["motion"]
    assert list(found["pooled"]) == ["pixels", "boxes", "ranking"]
    assert list(found["clips"]["clip"]["pixels"]) == ["f"]


def test_scores_are_read_back_as_they_were_written(missing, tmp_path):
    study = missing("one", 0.2, (1, 0))
    write_scores(tmp_path, "one", study.cases)
    again = read_scores(tmp_path)
    assert [case.clip for case in again.cases] == ["clip-0", "clip-1"]
    content = (tmp_path / SCORES).read_bytes()
    write_scores(tmp_path, "one", again.cases)
    assert (tmp_path / SCORES).read_bytes() == content
    assert np.array_equal(again.cases[1].scored.frames, study.cases[0].scored.frames)


def entry(first, second, says, interval=None, p=0.01):
    over_frames = {"interval": interval, "p": p, "p_holm": 2 * p, "enough": True}
    return {"first": first, "second": second, "change": second - first, "over_frames": over_frames, "says": says}


def comparison(clips):
    f = entry(0.5, 0.6, "better on these clips", [0.05, 0.15])
    f["over_clips"] = {"interval": [0.01, 0.2], "p": 0.2, "p_holm": 0.4, "enough": True}
    precision = entry(0.5, 0.0, "x") | {"second": None, "change": None}
    mine = {"same": ["untouched"], "pooled": {"pixels": {"f": f, "precision": precision}}, "clips": clips}
    return {"first": "a <b>", "second": "b", "tasks": {"motion": mine}, "notes": ["lost, motion: only in the first"]}


CLIPS = {
    "up <i>": {"pixels": {"f": entry(0.2, 0.5, "better", [0.1, 0.5])}},
    "down": {"pixels": {"f": entry(0.9, 0.7, "worse", [-0.3, -0.1])}},
    "quiet": {"pixels": {"f": entry(0.9, 0.901, "within noise", [-0.1, 0.1], 0.9)}},
}


def test_the_page_begins_with_what_changed_by_how_much_and_whether_that_is_beyond_noise():
    text = comparison_report(comparison(CLIPS))
    page = Page(text)
    assert "+0.100 F, pixels 0.500 → 0.600: better on these clips" in page.shown()
    assert "clips: 1 better beyond noise, 1 worse beyond noise, 1 changed within noise, 1 the same" in page.shown()
    assert "only in the first" in page.shown() and "untouched" in page.shown()
    assert not {"i", "b>"} & set(page.found)
    # The interval over clips stands before that over frames, and the raw p before the corrected one.
    assert "0.010 to 0.200" in text and "0.050 to 0.150" not in text
    values = page.values("td", "data-v")
    assert values[values.index("better on these clips") + 1 :][:4] == ["0.2", "0.4", "0.01", "0.02"]
    assert "raw p, clips" in text and "corrected p, clips" in text
    # The largest loss stands first in the plot.
    rows = [text.index(f">{name}</text>") for name in ("down", "quiet", "up &lt;i&gt;")]
    assert rows == sorted(rows)
    assert "1 the same" in Page(comparison_report(comparison({}))).shown()
