"""A table, its clip and its interval."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.table_checks import agreed, beginning
from torchvision_dddas.types import DetectionTable, is_sampled


def rows(frames, box_px=(10, 10, 5, 5), score=1.0):
    frames = np.array(frames, int)
    n = len(frames)
    boxes = np.broadcast_to(np.array(box_px, float), (n, 4))
    return DetectionTable("det.txt", frames, boxes, np.full(n, score), np.arange(n) + 1)


def clip(count, exact=True):
    return SimpleNamespace(name="walk.mp4", count=count, exact=exact, size=(64, 48))


def test_a_table_that_goes_with_its_clip_needs_no_word():
    assert agreed(rows([1, 2, 2, 5]), 1, clip(5)) == []
    assert agreed(rows([1, 6, 11]), 5, clip(14)) == []


def test_frames_after_the_end_of_a_clip_are_refused_with_the_first_such_line():
    with pytest.raises(
        InputError, match=r"det\.txt, line 3: .* frame 9 but walk\.mp4 ends after frame 5 \(2 of 4 rows"
    ):
        agreed(rows([1, 5, 6, 9]), 1, clip(5))


@pytest.mark.parametrize("source", [clip(5, exact=False), clip(None, exact=False), None])
def test_a_length_that_is_only_guessed_refuses_nothing(source):
    assert agreed(rows([1, 2, 9]), 1, source) == []


def test_rows_between_the_frames_looked_at_are_counted():
    table = rows([1, 2, 3, 4, 5, 6, 6])
    assert is_sampled(table.frame, 5).tolist() == [True, False, False, False, False, True, True]
    assert agreed(table, 5) == ["4 of 7 rows lie on frames that --interval 5 leaves out"]


def test_a_table_of_which_no_row_is_looked_at_is_refused():
    with pytest.raises(InputError, match=r"no row on frames 1, 6, 11, .* --interval 5 .* first is on frame 5"):
        agreed(rows([5, 10, 15]), 5)


def test_rows_on_every_fifth_frame_only_call_for_the_interval():
    (note,) = agreed(rows([1, 6, 21]), 1)
    assert "--interval 5 says" in note
    assert agreed(rows([1, 6]), 1) == []  # two frames are too few to tell


def test_scores_that_are_no_probabilities_own_rows_and_an_empty_table_are_told():
    (note,) = agreed(rows([1, 2, 3], score=43.3), 1)
    assert "from 43.3 to 43.3 are no probabilities" in note
    assert agreed(replace(rows([1, 2, 3], score=0.5), own=True), 1) == [
        "all rows are moving targets of dddas detect: every row counts as certain"
    ]
    assert agreed(rows([]), 1, clip(5)) == ["detections det.txt holds no rows"]


@pytest.mark.parametrize("box", [(-9, 10, 9, 5), (64, 10, 5, 5), (10, -5, 5, 5), (10, 48, 5, 5)])
def test_boxes_wholly_outside_the_picture_are_counted_and_those_at_its_edge_are_not(box):
    (note,) = agreed(rows([1, 2, 3], box), 1, clip(3))
    assert note.startswith("3 boxes lie wholly outside")
    x, y, w, h = box
    assert agreed(rows([1, 2, 3], (x - np.sign(x) * 0.5, y - np.sign(y) * 0.5, w, h)), 1, clip(3)) == []


def test_scores_too_low_for_any_track_are_noted_and_others_are_not():
    (note,) = beginning(rows([1, 2], score=0.8), 0.95)
    assert "det.txt reaches track.birth_score = 0.95" in note
    assert beginning(rows([1, 2], score=0.95), 0.95) == []
    assert beginning(replace(rows([1, 2], score=0.8), own=True), 0.95) == []
    assert beginning(rows([]), 0.95) == []
