"""Results of several methods on the same clips: studies that compare takes, with a report, tables and figures."""

import csv
import json

import pytest

from tests.lab.evaluation.studies.scored_clips import as_files, found_of, tracked, walk
from tests.pages import Page
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.evaluate import evaluate
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.evaluation.studies.cache import read_scores
from torchvision_dddas.lab.evaluation.studies.comparison import compare_studies
from torchvision_dddas.lab.evaluation.studies.methods import name_results, write_methods
from torchvision_dddas.lab.evaluation.studies.scoring import score


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    monkeypatch.setattr(bootstrap.effects, "__defaults__", (40, 40))
    monkeypatch.setattr(bootstrap.intervals, "__defaults__", (40,))


@pytest.fixture
def results(tmp_path):
    """Truth of two clips in gt/, and the tracks of two methods."""
    for seed in range(2):
        tracked(tmp_path / "gt" / f"clip-{seed}", seed)
        for name, miss in {"ours": 0.05, "sort": 0.4}.items():
            found = found_of(walk(seed, 30, miss=miss)[1], 33)
            as_files(tmp_path / name / f"clip-{seed}", found, identities=True)
    return {"ours": tmp_path / "ours", "the <sort>": tmp_path / "sort"}


def test_each_method_is_a_study_with_the_figures_of_evaluate(results, tmp_path):
    content = write_methods(tmp_path / "out", tmp_path / "gt", results)
    for name, place in results.items():
        mine = content["methods"][name]["tasks"]["tracking"]
        alone = evaluate(tmp_path / "gt", place)
        assert mine["pooled"]["tracks"] == alone["pooled"]["tracks"]
        assert mine["clips"]["clip-0"]["tracks"] == alone["clips"]["clip-0"]["tracks"]
    assert mine["pooled"]["intervals"]["tracks"]["mota"]
    studies = [read_scores(tmp_path / "out" / name) for name in results]
    again = compare_studies(*studies)["tasks"]["tracking"]["pooled"]["tracks"]["mota"]
    assert again == content["comparisons"][0]["tasks"]["tracking"]["pooled"]["tracks"]["mota"]
    assert again["says"] == "worse on these clips"


def test_the_report_the_tables_and_the_figures_name_each_method(results, tmp_path):
    out = tmp_path / "out"
    write_methods(out, tmp_path / "gt", results)
    page = Page((out / "report.html").read_text())
    assert "the <sort> against ours: HOTA −" in page.shown() and "sort" not in page.found
    rows = list(csv.DictReader((out / "tables" / "tracking-tracks.csv").open()))
    assert [row["method"] for row in rows] == list(results) and float(rows[0]["HOTA"]) > float(rows[1]["HOTA"])
    assert (out / "tables" / "tracking-the <sort>-against-ours.tex").is_file()
    assert (out / "figures" / "hota-tracks.svg").is_file()
    assert json.loads((out / "ours" / "run.json").read_text())["result"] == str(results["ours"])


def test_a_clip_that_a_method_lacks_counts_for_none(results, tmp_path):
    (tmp_path / "sort" / "clip-1" / "tracks.txt").unlink()
    content = write_methods(tmp_path / "out", tmp_path / "gt", results)
    assert list(content["methods"]["ours"]["tasks"]["tracking"]["clips"]) == ["clip-0"]
    assert "clip-1, tracking: not scored for every method, left out of ours" in content["notes"]
    (tmp_path / "sort" / "clip-0" / "tracks.txt").unlink()
    (tmp_path / "sort" / "clip-1" / "tracks.txt").write_text("1,1,0,0,9,9\n")
    (tmp_path / "ours" / "clip-1" / "tracks.txt").unlink()
    with pytest.raises(InputError, match="no clip has a score of every method"):
        write_methods(tmp_path / "other", tmp_path / "gt", results)
    assert not (tmp_path / "other").exists()


def test_the_only_clip_of_files_is_named_after_the_truth(results, tmp_path):
    files = {name: place / "clip-0" / "tracks.txt" for name, place in results.items()}
    content = write_methods(tmp_path / "out", tmp_path / "gt/clip-0/gt/gt.txt", files)
    assert list(content["methods"]["ours"]["tasks"]["tracking"]["clips"]) == ["clip-0"]


def test_boxes_of_files_have_the_counts_that_a_study_has_of_them(tmp_path):
    clip, found = tracked(tmp_path / "gt" / "clip", 3)
    as_files(tmp_path / "found" / "clip", found)
    write_methods(tmp_path / "out", tmp_path / "gt", {"a": tmp_path / "found"})
    (case,) = read_scores(tmp_path / "out" / "a").cases
    of_study = score(clip, "people", found)
    assert case.task == "motion" and case.scored.frames.tolist() == of_study.frames.tolist()


@pytest.mark.parametrize(
    ("names", "cause"),
    [
        (["a"], "--names has 1 names for 2 results"),
        (["a", "a"], "two results are named 'a'"),
        (["a", "../b"], "must consist of letters"),
        ([], "two results are named 'tracks'"),
    ],
)
def test_names_that_fit_no_folders_are_refused(names, cause, tmp_path):
    places = [tmp_path / side / "tracks.txt" for side in "ab"]
    for place in places:
        place.parent.mkdir()
        place.touch()
    with pytest.raises(InputError, match=cause):
        name_results(places, names)
