"""Scores of studies are those of `dddas evaluate`, to the last digit; still clips, refusals, errors in metres."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.lab.evaluation.studies import world
from tests.lab.evaluation.studies.scored_clips import as_files, found_of, masked, png, targeted, tracked
from torchvision_dddas.cli import app
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.evaluate import evaluate
from torchvision_dddas.lab.evaluation.metrics import truth as truths
from torchvision_dddas.lab.evaluation.metrics.registry import figures
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, Labels, TrackTable, TruePositions
from torchvision_dddas.lab.evaluation.studies.cache import pack, unpack
from torchvision_dddas.lab.evaluation.studies.records import round_as_written
from torchvision_dddas.lab.evaluation.studies.scoring import score
from torchvision_dddas.lab.evaluation.studies.stages import find


def with_truth(clip, **changes):
    return replace(clip, truth=replace(clip.truth, **changes))


def evaluated(clip, result, **how):
    """What dddas evaluate gives, of one clip."""
    (found,) = evaluate(clip.place, result, **how)["clips"].values()
    return found


def counts(scored, group) -> Any:
    """The counts of a group, of whatever kind."""
    return scored.counts[group]


def scored_of(clip, task, found, interval=1):
    one = score(clip, task, found, interval)
    return {"frames": len(one.frames), **figures(one.counts)}


@pytest.mark.parametrize(
    ("make", "task", "seed", "interval"),
    [
        *((masked, "motion", 1, 1), (targeted, "motion", 0, 1), (targeted, "tracking", 1, 1)),
        *((tracked, "tracking", 0, 1), (tracked, "tracking", 1, 3), (tracked, "tracking", 2, 3)),
    ],
)
def test_figures_are_those_of_evaluate_to_the_last_digit(tmp_path, make, task, seed, interval):
    clip, found = make(tmp_path / "clip", seed)
    if interval > 1:
        rows = np.c_[found.frame, found.identity, found.box_px, found.score][(found.frame - 1) % interval == 0]
        found = replace(found_of(rows, 33), looked=np.arange(1, 34, interval))
    out = as_files(tmp_path / "out", found, interval, identities=task == "tracking")
    mine = scored_of(clip, task, found, interval)
    assert mine == evaluated(clip, out, interval=interval)
    assert make is not tracked or mine["tracks"]["n_fp"] > 0


def test_what_dddas_detect_writes_of_a_clip_scores_the_same_as_in_a_study(tmp_path):
    place = world.filmed(tmp_path, "plates", 3, 12)
    words = ["detect", place / "frames", "--out", tmp_path / "out", "--save", "masks", "--backend", "onboard"]
    app([*map(str, words), "--quiet"], standalone_mode=False)
    (clip,) = world.clips_in(tmp_path, "plates")
    mine = scored_of(clip, "motion", find(clip, "motion", Settings(), "onboard"))
    assert mine == evaluated(clip, tmp_path / "out")
    assert mine["boxes"]["n_hit"] > 0


@pytest.mark.parametrize(("make", "task"), [(masked, "motion"), (tracked, "tracking"), (targeted, "tracking")])
def test_frames_add_up_to_the_clip_and_come_back_from_the_cache(tmp_path, make, task):
    clip, found = make(tmp_path / "clip", 5)
    one = unpack(pack(score(clip, task, found)))
    assert figures(one.counts) == figures(score(clip, task, found).counts)
    for group in one.counts:
        whole = counts(one, group).clear if group == "tracks" else counts(one, group)
        for name, of_frames in one.per_frame[group].items():
            if not name.startswith(("windows_", "ar_")):
                assert np.nansum(of_frames) == pytest.approx(getattr(whole, name))
    if "tracks" in one.counts:
        assert np.nansum(one.per_frame["tracks"]["ar_3"]) == pytest.approx(counts(one, "tracks").links_3.total)


def test_ranked_detections_are_right_false_or_do_not_count(tmp_path):
    clip, found = tracked(tmp_path / "clip", 2)
    one = score(with_truth(clip, ignoring="removed"), "people", found)
    rows, boxes = one.ranked["boxes"], counts(one, "boxes")
    assert len(rows) == np.isin(found.frame, clip.truth.frames).sum() and np.isnan(rows[:, 1]).any()
    assert (np.nansum(rows[:, 1]), np.count_nonzero(~np.isnan(rows[:, 1]))) == (boxes.hit, boxes.hit + boxes.false)


def test_boxes_where_the_mask_is_unlabelled_do_not_count(tmp_path):
    clip, found = masked(tmp_path / "clip", 0)
    labels = truths.read_mask(clip.truth.masks[1])
    labels[:, 40:] = 170
    clip.truth.masks[1].write_bytes(png(labels.astype(np.uint8)))
    there = np.array([[1, -1, 50, 5, 10, 10, 0.9], [1, -1, 30, 5, 10, 10, 0.8]])
    marked = with_truth(clip, labels=Labels(unscored=(170,)))
    rows = score(marked, "motion", found_of(there, 12, found.masks, False)).ranked["boxes"]
    assert np.isnan(rows[:, 1]).tolist() == [True, False]


def test_whatever_is_found_in_a_still_clip_is_false(tmp_path):
    rows = np.array([[2, -1, 0, 0, 5, 5, 0.5], [2, -1, 20, 0, 5, 5, 0.5], [4, -1, 0, 0, 5, 5, 0.5]])
    some, none = (
        score(Clip("still", tmp_path, still=True), "motion", found_of(found, 8, identities=False))
        for found in (rows, rows[:0])
    )
    wanted = {"false_blobs_per_frame": 3 / 8, "alarmed": 2 / 8, "n_frames": 8, "n_alarmed": 2, "n_blobs": 3}
    assert figures(some.counts)["still"] == wanted
    assert some.per_frame["still"]["blobs"].tolist() == [0, 2, 0, 1, 0, 0, 0, 0]
    assert figures(none.counts)["still"]["false_blobs_per_frame"] == 0


def test_results_that_cannot_be_scored_are_one_line(tmp_path):
    clip, found = masked(tmp_path / "clip")
    wide = {f: png(np.zeros((60, 90), np.uint8)) for f in found.masks}
    refused: list[Any] = [
        (None, "motion", found, "clip has no truth, so that it cannot be scored"),
        (clip.truth, "location", found, "no true places"),
        (clip.truth, "motion", replace(found, masks={1: found.masks[1]}), "frame 3 is labelled, but has no result"),
        (clip.truth, "motion", replace(found, masks=wide), "the truth is 80×60 pixels"),
        (clip.truth, "motion", replace(found, looked=np.arange(1, 6)), "labels frame 11"),
    ]
    for truth, task, result, message in refused:
        with pytest.raises(InputError, match=message):
            score(replace(clip, truth=truth), task, result)


def test_boxes_are_rounded_as_their_text_is():
    rng = np.random.default_rng(0)
    boxes = np.concatenate([rng.uniform(-50, 2000, (500, 4)), rng.integers(-5000, 90000, (500, 4)) / 1000 + 0.005])
    assert np.array_equal(round_as_written(boxes), [[float(f"{v:.2f}") for v in row] for row in boxes.tolist()])


def located(tmp_path, off=(0.6, 0.8), sigma_m=1.0):
    """Two people, found `off` metres from where they are, and a vehicle; a third place belongs to no target."""
    frame, who = np.repeat(np.arange(1, 11), 3), np.tile([1, 2, 9], 10)
    place = np.stack([10.0 * who + frame, 5.0 * frame], axis=1)
    px = np.stack([20.0 * who, frame, np.full(30, 8.0), np.full(30, 16.0)], axis=1)
    seen = who != 9
    by_frame = {f: px[(frame == f) & seen] for f in range(1, 11)}
    tracks = TrackTable(frame[seen], who[seen], px[seen])
    truth = ClipTruth("boxes", tmp_path, {}, by_frame, tracks, positions=TruePositions(frame, who, place))
    rows = np.insert(np.c_[frame[seen], who[seen], px[seen], np.ones(20)], 4, [3, 77, 500, 500, 8, 16, 1.0], axis=0)
    found = replace(
        found_of(rows, 10),
        east_north_m=np.insert(place[seen] + np.array(off), 4, (900.0, 900.0), axis=0),
        covariance_m2=np.broadcast_to(np.eye(2) * sigma_m**2, (21, 2, 2)),
    )
    return Clip("ground", tmp_path, truth=truth), found


@pytest.mark.parametrize("boxes", [True, False])
def test_errors_in_metres_are_those_that_were_made(tmp_path, boxes):
    clip, found = located(tmp_path)
    one = score(clip, "location", found if boxes else replace(found, box_px=np.full((21, 4), np.nan)))
    assert one.samples["error_m"] == pytest.approx(np.ones(20))
    assert one.samples["inside"].tolist() == [1] * 20
    assert counts(one, "location") == (20 if boxes else 30, 20, 1)  # only the boxes say who can be seen
    assert bool(one.notes) != boxes
    assert np.isnan(one.samples["relative_error_m"]).all()


def test_an_ellipse_that_is_too_small_does_not_hold_the_truth(tmp_path):
    clip, found = located(tmp_path, sigma_m=0.4)  # 1 m is 2.5 sigmas: 6.25 > 5.991
    assert score(clip, "location", found).samples["inside"].tolist() == [0] * 20


def test_the_error_relative_to_the_team_is_what_the_landmarks_do_not_share(tmp_path):
    clip, found = located(tmp_path, off=(3.0, 4.0))
    known = clip.truth.positions
    fleet = TruePositions(
        *(column[known.identity == 9] for column in (known.frame, known.identity, known.east_north_m))
    )
    places = zip(fleet.frame, fleet.east_north_m, strict=True)
    marks = "".join(f"{f},rover,{east + 3.0:.6f},{north + 3.0:.6f}\n" for f, (east, north) in places)
    (tmp_path / "landmarks.csv").write_text(f"frame,landmark,east_m,north_m\n{marks}")
    found = replace(found, more={"relative_m2": np.broadcast_to(np.eye(2), (21, 2, 2))})
    clip = replace(clip, landmarks=tmp_path / "landmarks.csv")
    assert np.isnan(score(clip, "location", found).samples["relative_error_m"]).all()  # nobody knows where it was
    one = score(with_truth(clip, fleet=fleet), "location", found)
    assert one.samples["error_m"] == pytest.approx(np.full(20, 5.0))
    assert one.samples["relative_error_m"] == pytest.approx(np.full(20, 1.0))
    assert one.samples["relative_inside"].tolist() == [1] * 20


def test_a_place_of_a_target_that_does_not_count_is_neither_right_nor_nobodys(tmp_path):
    clip, found = located(tmp_path)
    mine, other = (clip.truth.tracks.at(clip.truth.tracks.identity == who) for who in (1, 2))
    assert counts(score(with_truth(clip, tracks=mine, ignored=other), "location", found), "location") == (10, 10, 1)


def test_degrees_are_compared_where_both_sides_count_metres_from_origins_of_their_own(tmp_path):
    clip, found = located(tmp_path)
    true, origin = clip.truth.positions, (-110.9, 32.2)
    degrees, of_found = (lonlat(place_m, origin) for place_m in (true.east_north_m, found.east_north_m))
    found = replace(found, east_north_m=found.east_north_m + 777, more={"lonlat_deg": of_found})
    clip = with_truth(clip, positions=replace(true, lonlat_deg=degrees))
    assert score(clip, "location", found).samples["error_m"] == pytest.approx(np.ones(20), abs=1e-3)
