"""The report of a study, its words and its pictures."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.lab.evaluation.report import studied
from tests.lab.evaluation.report.studied import FRAMES, HOSTILE, SIZE, masked_clip, tracked_clip
from tests.pages import Page
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth
from torchvision_dddas.lab.evaluation.report import study_report, worst_frames
from torchvision_dddas.lab.evaluation.report.task_charts import MOST_FAINT, ranked_charts
from torchvision_dddas.lab.evaluation.report.worst_frames import (
    FALSE,
    HIT,
    MAX_PICTURES,
    TRUE,
    UNSCORED,
    find_worst_frames,
)
from torchvision_dddas.lab.evaluation.studies.summary import summarize


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return studied.study(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def metrics(results):
    return finite(summarize(results))


@pytest.fixture(scope="module")
def text(results, metrics):
    return study_report(metrics, results)


def decode(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def near(pixel, colour, within=60):
    return bool(np.abs(np.asarray(pixel, int) - colour).max() < within)


def test_the_page_is_whole_escaped_repeatable_and_asks_no_host_for_anything(text, results, metrics):
    page = Page(text)
    assert text.count("</html>") == 1 and "masks" not in page.found and "study" not in page.found
    for words in (HOSTILE, "small <study>", "its <masks> are 3x3, the result 4x4", "numpy", "free"):
        assert words in page.shown()
    assert json.dumps(finite(results.settings.model_dump(mode="json")), indent=2) in "".join(page.words)
    assert not re.search(r"https?:|url\(|@import|<link|<iframe|src=\"(?!data:)", text)
    assert study_report(metrics, results) == text


def test_the_page_begins_with_how_good_how_sure_where_it_fails_and_what_it_cost(text, metrics):
    start = text[text.index("<h1>") : text.index('<h2 id="motion">')]
    motion = metrics["tasks"]["motion"]["pooled"]
    low, high = motion["intervals"]["pixels"]["f"]
    for part in (
        f"{motion['pixels']['f']:.3f} F, pixels",
        f"95 % interval over blocks of frames: {low:.3f} to {high:.3f}",
        "worst: bad, 0.333",
        "4.0 frames/s (3.0 s), at most 101 MB",
        "1 left out",
        "lost: it has no truth",
    ):
        assert part in Page(f"<html>{start}</html>").shown()


def test_every_figure_of_the_tables_is_that_of_the_metrics(text, metrics):
    values = {float(value) for value in Page(text).values("td", "data-v") if re.fullmatch(r"[-+.e\d]+", value)}
    for clip in ("good", "bad"):
        for group in ("pixels", "boxes", "ranking"):
            of_clip = metrics["tasks"]["motion"]["clips"][clip][group]
            assert {v for k, v in of_clip.items() if not k.startswith("n_") and v is not None} <= values


def test_a_study_without_results_or_pictures_still_has_a_page(results, metrics, tmp_path):
    empty = replace(results, cases=tuple(case for case in results.cases if case.cause))
    shown = Page(study_report(finite(summarize(empty)), empty)).shown()
    assert "0 clips" in shown and "4x4" in shown
    blind = studied.study(tmp_path)
    for file in (tmp_path / "bad" / "frames").iterdir():
        file.unlink()
    page = Page(study_report(metrics, blind))
    assert "no picture: " in page.shown()
    assert sum(tag == "img" for tag in page.found) >= 4  # those of other tasks


def test_the_worst_frames_come_first_bounded_over_clips_and_the_others_are_counted(tmp_path):
    cases = [masked_clip(tmp_path, "good", 0), masked_clip(tmp_path, "bad", 4), masked_clip(tmp_path, "fair", 2)]
    chosen, others = find_worst_frames(cases)
    assert [(one.case.clip.name, one.frame) for one in chosen[:2]] == [("bad", 5), ("fair", 6)]
    assert chosen[0].text == "F 0.00; pixels: 0 right, 400 false, 400 missed"
    assert len(chosen) + others == 2 * FRAMES and "good" not in {one.case.clip.name for one in chosen}
    many = [replace(cases[1], clip=replace(cases[1].clip, name=f"bad {k}")) for k in range(30)]
    chosen, others = find_worst_frames(many)
    assert len(chosen) == len({one.case.clip.name for one in chosen}) == MAX_PICTURES
    assert others == 30 * FRAMES - MAX_PICTURES


def test_a_mask_shows_what_was_hit_false_and_missed_each_in_its_colour():
    labels, mask = np.zeros((120, 160), int), np.zeros((120, 160), np.uint8)
    labels[20:60, 20:80], mask[20:60, 50:110] = 1, 255
    labels[90:110, 90:150], mask[90:110, 90:150] = -1, 255
    truth, result = map(decode, worst_frames.mask_pair(np.full((120, 160, 3), 90, np.uint8), labels, mask))

    def at(picture, x, y):
        return picture[round(y * result.shape[1] / 160), round(x * result.shape[1] / 160)]

    for x, y, colour in ((35, 40, TRUE), (65, 40, HIT), (95, 40, FALSE), (120, 100, UNSCORED), (5, 5, (90, 90, 90))):
        assert near(at(result, x, y), colour)
    # On the other side what is true is tinted, and nothing else.
    assert at(truth, 35, 40)[0] < 85 < at(truth, 35, 40)[2] and near(at(truth, 95, 40), (90, 90, 90), 12)


def test_a_fault_of_few_pixels_is_seen_in_a_large_picture():
    labels, mask = np.zeros((2160, 3840), int), np.zeros((2160, 3840), np.uint8)
    mask[1000:1005, 2000:2005] = 255
    pair = worst_frames.mask_pair(np.zeros((2160, 3840, 3), np.uint8), labels, mask)
    result = decode(pair.result).astype(int)
    assert result.shape[1] <= 560
    assert (result[..., 2] - result[..., 0]).max() > 60


def test_boxes_differ_by_their_lines_too():
    true_px, found_px = np.array([[10, 10, 40, 40], [100, 10, 40, 40]], float), np.array([[12, 10, 40, 40.0]])
    boxes = worst_frames.FrameBoxes(
        true_px, found_px, np.array([0]), ["", ""], [""], np.zeros(1, bool), np.ones(1, bool)
    )
    result = decode(worst_frames.box_pair(None, SIZE, boxes).result)
    scale = result.shape[1] / SIZE[0]
    lower = result[round(50 * scale), round(100 * scale) : round(140 * scale)]
    assert 0.2 < np.mean([near(pixel, TRUE, 90) for pixel in lower]) < 0.9  # dashed
    assert near(result[round(30 * scale), round(12 * scale)], HIT, 90)


def test_a_change_of_identity_is_named_and_the_lost_target_is_missed(tmp_path):
    case = tracked_clip(tmp_path, "tracking", "crossing")
    at_4, at_5 = (worst_frames.boxes_at(case, frame) for frame in (4, 5))
    assert at_4.found_names == ["1>9", "2"] and at_4.marked.tolist() == [True, False]
    assert at_5.found_names == ["9"] and len(at_5.true_px) == 2 and at_5.of_found.tolist() == [0]
    texts = {one.frame: one.text for one in find_worst_frames([case])[0]}
    assert texts[4].endswith("1 changed identity") and texts[5] == "F1 0.67; boxes: 1 right, 0 false, 1 missed"


def test_beside_one_labelled_target_other_boxes_are_not_judged(tmp_path):
    one = {frame: boxes[:1] for frame, boxes in studied.boxed_truth(tmp_path).boxes.items()}
    clip = Clip("one", tmp_path, (), 10.0, FRAMES, ClipTruth("one target", tmp_path, {}, one))
    boxes = worst_frames.boxes_at(replace(tracked_clip(tmp_path, "tracking", "x"), clip=clip, task="motion"), 1)
    assert boxes.of_found.tolist() == [0, -1] and boxes.judged.tolist() == [True, False]


def test_in_a_still_clip_every_box_is_false_and_drawn(tmp_path):
    still = Clip("still", tmp_path, (), 10.0, FRAMES, None, still=True)
    found = studied.found([2, 2, 5], [[10, 10, 9, 9], [40, 40, 9, 9], [20, 20, 9, 9]])
    chosen, others = find_worst_frames([studied.scored(still, "motion", found)])
    assert (chosen[0].frame, others) == (2, 0)
    assert chosen[0].text == "F1 0.00; boxes: 0 right, 2 false, 0 missed"
    pair = worst_frames.draw_pictures(chosen)[0].pair
    assert pair is not None and any(near(pixel, FALSE, 30) for pixel in decode(pair.result).reshape(-1, 3))


def test_a_video_gives_the_frames_that_were_asked_for(tmp_path):
    case, path = masked_clip(tmp_path, "bad", 4), tmp_path / "clip.avi"
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    for k in range(FRAMES):
        film.write(np.full((SIZE[1], SIZE[0], 3), 40 * k, np.uint8))
    film.release()
    case = replace(case, clip=replace(case.clip, pictures=(path,)))
    for one in worst_frames.draw_pictures(find_worst_frames([case])[0]):
        assert one.pair is not None
        assert abs(float(decode(one.pair.truth)[:20].mean()) - 40 * (one.frame - 1)) < 8


def test_matched_boxes_are_those_that_are_counted():
    assert worst_frames.matched(np.array([[0.9, 0.6], [0.8, 0.0]])).tolist() == [0, -1]


def test_curves_of_many_clips_are_bounded_and_the_legend_counts_them(tmp_path):
    case = tracked_clip(tmp_path, "people", "x")
    many = [replace(case, clip=replace(case.clip, name=f"clip {k}")) for k in range(100)]
    first, second = ranked_charts(many)
    assert first.count('class="faint') == second.count('class="faint') == MOST_FAINT
    assert f"{MOST_FAINT} of 100 clips" in first and "all clips" in first
