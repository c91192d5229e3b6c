import json
from dataclasses import replace

import numpy as np
import pytest

from tests.evaluation.studies.scored_clips import found_of, masked, tracked, walk
from torchvision_dddas.cli import app
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.studies import comparison
from torchvision_dddas.evaluation.studies.cache import SCORES, read_scores, write_scores
from torchvision_dddas.evaluation.studies.comparison import compare_studies
from torchvision_dddas.evaluation.studies.records import ScoredCase, ScoredStudy
from torchvision_dddas.evaluation.studies.scoring import score


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    """Few samples: none of these properties needs many."""
    monkeypatch.setattr(bootstrap.effects, "__defaults__", (100, 300))


def of_tracks(folder, name, miss, clips=range(8)) -> ScoredStudy:
    """Clips of which a share of the boxes is missed."""
    cases = []
    for seed in clips:
        place = folder / f"clip-{seed}"
        clip, _ = tracked(place if not place.exists() else folder / name / f"clip-{seed}", seed)
        found = found_of(walk(seed, 30, miss=miss)[1], 33)
        cases.append(ScoredCase("tracking", f"clip-{seed}", score(clip, "tracking", found)))
    return ScoredStudy(name, tuple(cases))


def test_a_study_beside_itself_is_the_same(tmp_path):
    one = of_tracks(tmp_path, "one", 0.2, range(3))
    found = compare_studies(one, one)["tasks"]["tracking"]
    assert found["same"] == ["clip-0", "clip-1", "clip-2"]
    assert found["clips"] == {}
    assert {entry["says"] for entry in found["pooled"]["tracks"].values()} == {"the same"}


def test_what_got_worse_everywhere_is_worse_beyond_noise(tmp_path):
    found = compare_studies(of_tracks(tmp_path, "one", 0.05), of_tracks(tmp_path, "two", 0.6))["tasks"]["tracking"]
    mota = found["pooled"]["tracks"]["mota"]
    assert mota["says"] == "worse"
    assert mota["change"] == mota["second"] - mota["first"] < 0
    assert mota["over_clips"]["p"] == pytest.approx(2 / 2**8)
    assert mota["over_clips"]["p"] < mota["over_clips"]["p_holm"] < 0.05
    assert mota["over_clips"]["interval"][0] < mota["change"] < mota["over_clips"]["interval"][1] < 0
    assert len(found["clips"]) == 8


def test_other_noise_of_the_same_size_is_within_noise(tmp_path):
    found = compare_studies(of_tracks(tmp_path, "one", 0.2), of_tracks(tmp_path, "two", 0.21))["tasks"]["tracking"]
    assert {entry["says"] for entry in found["pooled"]["tracks"].values()} <= {"within noise", "the same"}
    assert found["pooled"]["tracks"]["mota"]["over_clips"]["enough"]


def test_few_clips_are_said_to_tell_too_little_or_only_of_themselves(tmp_path):
    one, two = of_tracks(tmp_path, "one", 0.05, range(2)), of_tracks(tmp_path, "two", 0.7, range(2))
    pooled = compare_studies(one, two)["tasks"]["tracking"]["pooled"]["tracks"]
    assert pooled["mota"]["over_clips"] is None
    assert pooled["mota"]["says"] == "worse on these clips"
    assert pooled["hota"]["says"] == "too little to tell"  # of whole tracks: frames say nothing of it


def test_the_order_of_cases_changes_nothing(tmp_path):
    one, two = of_tracks(tmp_path, "one", 0.1, range(6)), of_tracks(tmp_path, "two", 0.3, range(6))
    turned = [ScoredStudy(study.name, study.cases[::-1]) for study in (one, two)]
    assert json.dumps(compare_studies(one, two)) == json.dumps(compare_studies(*turned))


def test_clips_of_one_study_alone_are_named_and_no_common_clip_is_refused(tmp_path):
    one, two = of_tracks(tmp_path, "one", 0.1, (0, 1)), of_tracks(tmp_path, "two", 0.2, (1, 2))
    found = compare_studies(one, two)
    assert found["notes"] == [
        "clip-0, tracking: only in the first study, one",
        "clip-2, tracking: only in the second study, two",
    ]
    with pytest.raises(InputError, match=r"no clip of the same task .* the first has clip-0 \(tracking\), the second"):
        compare_studies(ScoredStudy("one", one.cases[:1]), ScoredStudy("two", two.cases[1:]))
    with pytest.raises(InputError, match="the second nothing"):
        compare_studies(one, ScoredStudy("two", ()))


def test_another_truth_or_other_frames_are_not_compared(tmp_path):
    one, two = of_tracks(tmp_path, "one", 0.1, (0, 1)), of_tracks(tmp_path, "two", 0.2, (0, 1))
    clip, found = tracked(tmp_path / "more" / "clip", 0)
    assert clip.truth is not None
    assert clip.truth.tracks is not None
    fewer = replace(
        clip, truth=replace(clip.truth, tracks=clip.truth.tracks.at(np.arange(1, len(clip.truth.tracks.frame))))
    )
    other = ScoredCase("tracking", "clip-0", score(fewer, "tracking", found))
    notes = compare_studies(one, ScoredStudy("two", (other, two.cases[1])))["notes"]
    assert len(notes) == 1
    assert "clip-0, tracking: its truth is another" in notes[0]
    short, found = tracked(tmp_path / "more" / "short", 0, 20)
    other = ScoredCase("tracking", "clip-0", score(short, "tracking", found))
    with pytest.raises(InputError, match="no clip can be compared; clip-0, tracking: other frames were scored"):
        compare_studies(ScoredStudy("one", one.cases[:1]), ScoredStudy("two", (other,)))


def test_less_is_better_where_it_is(tmp_path):
    entry = {"change": -0.1, "over_frames": {"p_holm": 0.01, "enough": True}}
    assert comparison.verdict(entry, "log_average_miss_rate") == "better"
    assert comparison.verdict(entry, "f") == "worse"


def test_masks_are_compared_by_pixels_boxes_and_ranks(tmp_path):
    cases = []
    for seed in (1, 2):
        clip, found = masked(tmp_path / f"{seed}" / "clip", 0)
        if seed == 2:
            blank = dict.fromkeys(found.masks, found.masks[1])
            found = found_of(walk(0, 12)[1][::2], 12, blank, False)
        cases.append(ScoredStudy(f"{seed}", (ScoredCase("motion", "clip", score(clip, "motion", found)),)))
    found = compare_studies(*cases)["tasks"]["motion"]
    assert list(found["pooled"]) == ["pixels", "boxes", "ranking"]
    assert list(found["clips"]["clip"]["pixels"]) == ["f"]


def run(*words) -> int:
    return app([*map(str, words)], standalone_mode=False) or 0


def test_the_command_shows_tables_or_json(tmp_path, capsys):
    for name, miss in (("one", 0.05), ("two", 0.6)):
        (tmp_path / name).mkdir()
        study = of_tracks(tmp_path, name, miss, range(6))
        write_scores(tmp_path / name, name, study.cases)
    assert run("compare", tmp_path / "one", tmp_path / "two") == 0
    shown = capsys.readouterr().out
    assert "tracking, 6 clips together" in shown
    assert "worse on these clips" in shown
    run("compare", tmp_path / "one", tmp_path / "two", "--json")
    said = json.loads(capsys.readouterr().out)
    assert said["tasks"]["tracking"]["pooled"]["tracks"]["mota"]["says"] == "worse on these clips"


def test_what_is_no_study_is_one_line_and_exit_2(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    for content, words in (
        (None, "holds no study: no scores.bin"),
        (b"x" * 100, "is damaged or of another version"),
    ):
        if content is not None:
            (tmp_path / "a" / SCORES).write_bytes(content)
        assert run("compare", tmp_path / "a", tmp_path / "a") == 2
        said = capsys.readouterr().err
        assert said.startswith("dddas: ")
        assert words in said
        assert said.count("\n") == 1


def test_scores_are_read_back_as_they_were_written(tmp_path):
    study = of_tracks(tmp_path, "one", 0.2, (1, 0))
    write_scores(tmp_path, "one", study.cases)
    again = read_scores(tmp_path)
    assert [case.clip for case in again.cases] == ["clip-0", "clip-1"]
    content = (tmp_path / SCORES).read_bytes()
    write_scores(tmp_path, "one", again.cases)
    assert (tmp_path / SCORES).read_bytes() == content
    assert np.array_equal(again.cases[1].scored.frames, study.cases[0].scored.frames)
