"""The tracker's family: what the tracker knows of true links, the owners of detections, the likelihood of links."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.lab.tuning.worlds import seen, walk
from torchvision_dddas.config import Settings, TrackParameters, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable
from torchvision_dddas.lab.tuning.descent import Plan, descend
from torchvision_dddas.lab.tuning.examples import match_owners
from torchvision_dddas.lab.tuning.parameters import Parameters
from torchvision_dddas.lab.tuning.tracking import Stretches, TrackingFamily, link_nll
from torchvision_dddas.tracking import kalman, track_table
from torchvision_dddas.tracking.scene import SceneState
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.tracking.scores import BoxLook, association_scores, newborn_scores
from torchvision_dddas.types import DetectionTable

LEARNED = ("time", "step", "density", "missing", "turnover")


@pytest.mark.parametrize("task", ["association", "tracking"])
def test_what_is_known_in_each_frame_is_what_the_tracker_knows(task, tmp_path, monkeypatch: pytest.MonkeyPatch):
    clip, settings, plain = seen(walk(people=6, frames=100), tmp_path, false=0), Settings(), ScoreTracker._commit
    scenes = []

    def commit(self, now, *rest):
        scenes.append(self.scene.state(now.time))
        plain(self, now, *rest)

    monkeypatch.setattr(ScoreTracker, "_commit", commit)
    (example,) = TrackingFamily().at(5, task).examples([clip], settings)
    assert clip.given is not None and clip.truth is not None and clip.truth.tracks is not None
    true = clip.truth.tracks.every(5)
    table = DetectionTable("", true.frame, true.box_px, np.ones(len(true.frame)), np.arange(len(true.frame)))
    list(track_table(table if task == "association" else read_detections(clip.given), settings, 5))
    for name in LEARNED:
        assert example.content[name].tolist() == pytest.approx([getattr(scene, name) for scene in scenes]), name


def test_the_task_says_whether_true_boxes_or_detections_are_learned_from(tmp_path: Path):
    clip = seen(walk(), tmp_path)
    of = [TrackingFamily().at(5, task) for task in ("association", "tracking")]
    settings = with_parameters(Settings(), {"track.doubt": 1000.0, "track.birth_doubt": 1.0})
    true, found = (family.examples([clip], settings)[0].content for family in of)
    assert true["there"].all() and true["certain"].all() and true["begins"].all()
    assert of[1].measure == "tracking.tracks.idf1"
    assert (found["certain"] <= found["there"]).all() and (found["begins"] <= found["there"]).all()
    assert found["certain"].sum() < found["begins"].sum() < found["there"].sum()
    # Four people who are missed now and then, and one false alarm a look.
    assert sorted(found["there"].sum(0).tolist())[-5] == 1
    assert found["there"].sum(1).max() == 5


def test_what_cannot_be_tuned_is_refused_in_one_line(tmp_path: Path):
    family, path = TrackingFamily().at(5, "tracking"), tmp_path / "faint.txt"
    with pytest.raises(InputError, match="walk has no public detections"):
        family.examples([walk()], Settings())
    path.write_text("1,-1,10,10,20,50,0.5\n")
    with pytest.raises(InputError, match=r"no box that track\.doubt = 0 accepts"):
        family.examples([replace(walk(), given=path)], with_parameters(Settings(), {"track.doubt": 0.0}))
    with pytest.raises(InputError, match=r"no effect under track\.mode=paper; add --set track.mode=default"):
        family.check(["track.wander"], with_parameters(Settings(), {"track.mode": "paper"}))


@pytest.mark.slow
def test_a_wrong_parameter_gets_better_by_descending():
    settings, family = with_parameters(Settings(), {"track.scatter": 0.5}), TrackingFamily(interval=5)
    parameters = Parameters(settings, ["track.scatter"])
    done = descend(family, parameters, family.examples([walk()], settings), Plan(6, 2, 0.3, look_every=3))
    assert done.settings.track.scatter < 0.4 and not done.failed


ONE, OTHER, FAR = [100.0, 50.0, 20.0, 50.0], [112.0, 50.0, 20.0, 50.0], [300.0, 50.0, 20.0, 50.0]


def table(rows: list[tuple[int, int, list[float]]]) -> TrackTable:
    frame, identity, box_px = zip(*rows, strict=True)
    return TrackTable(np.array(frame), np.array(identity), np.array(box_px))


def truth_of(rows: list[tuple[int, int, list[float]]], **more) -> ClipTruth:
    return ClipTruth("boxes", Path("here"), {}, {}, table(rows), **more)


def found_of(rows: list[tuple[int, list[float], float]]) -> DetectionTable:
    frame, box_px, score = zip(*rows, strict=True)
    return DetectionTable("det", np.array(frame), np.array(box_px), np.array(score), np.arange(len(rows)))


def test_each_target_owns_the_box_that_fits_it_best_and_what_nobody_owns_is_another_each_time():
    truth = truth_of([(1, 7, ONE), (1, 9, OTHER), (2, 7, ONE)])
    near = [OTHER[0] - 2, *OTHER[1:]]
    found = found_of([(1, near, 0.9), (1, ONE, 1.0), (1, ONE, 0.4), (1, FAR, 0.85), (2, FAR, 0.85)])
    strict = Settings().track.model_copy(update={"doubt": 2.0, "birth_doubt": 1.0})
    mine = match_owners(found, truth, 1, strict)
    second, first, *nobody = mine.table.identity.tolist()
    assert first != second and min(first, second) >= 0 > max(nobody) and nobody[0] != nobody[1]
    # The median doubt is 0.15 in the first frame and 0.2 in both.
    assert mine.score.tolist() == [0.9, 1.0, 0.85, 0.85] and mine.begins.tolist() == [True, True, False, True]
    assert match_owners(found, truth, 5, strict).table.frame.tolist() == [1, 1, 1]


def test_who_is_no_mistake_to_find_owns_a_box_and_is_nobody_else():
    truth = truth_of([(1, 7, ONE)], ignored=table([(1, 7, FAR), (2, 7, FAR)]), ignoring="removed")
    mine = match_owners(found_of([(1, ONE, 1.0), (1, FAR, 1.0), (2, FAR, 1.0)]), truth, 1, Settings().track)
    one, other, again = mine.table.identity.tolist()
    assert other == again >= 0 and one != other


SCORES = "wander scatter size_scatter tail upright crossing hiding rest_drift rest_price"
NAMES = [f"track.{name}" for name in SCORES.split()]


def walkers(count: int = 6, frames: int = 10, scatter: float = 0.06, hide: bool = True, seed: int = 0) -> Stretches:
    """Stretches of people who walk about and are now and then not seen; one pair of walks each of two scenes."""
    draw = np.random.default_rng(seed)
    time = np.tile(0.2 + np.arange(frames), (2, 1))
    place = draw.uniform(100, 400, (2, 1, count, 2))
    velocity = np.cumsum(draw.normal(0, 0.6, (2, frames, count, 2)), axis=1) + draw.normal(0, 2, (2, 1, count, 2))
    height = 50 * np.exp(draw.normal(0, 0.1, (2, frames, count)))
    centre = place + np.cumsum(velocity * 5, axis=1) + scatter * 50 * draw.normal(size=(2, frames, count, 2))
    size = np.stack([0.4 * height, height], -1)
    there = draw.uniform(size=(2, frames, count)) > (0.2 if hide else 0.0)
    each = {"step": 0.3, "density": 4e-5, "missing": 0.1, "turnover": 0.05}
    parts: dict[str, np.ndarray] = {name: np.full((2, frames), value) for name, value in each.items()}
    parts |= dict.fromkeys(("there", "certain", "begins"), there)
    parts |= {"time": time, "size": np.full((2, 2), 500.0), "own": np.zeros(2, bool)}
    parts |= {"box_px": np.concatenate([centre - size / 2, size], -1), "motion": np.tile(np.eye(3), (2, frames, 1, 1))}
    parts |= {"likeness": np.full((2, frames, count, count), np.nan), "visible": np.ones((2, frames, count))}
    return Stretches(**{name: torch.as_tensor(value) for name, value in parts.items()})


def track(values: dict[str, Tensor]) -> TrackParameters:
    mine = {name.removeprefix("track."): value for name, value in values.items()}
    return TrackParameters.model_construct(**(dict(Settings().track) | mine))


@pytest.mark.parametrize("scores", [association_scores, newborn_scores])
def test_a_batch_of_tensors_is_scored_as_arrays_are(scores: Any):
    parameters, box = Settings().track, walkers().box_px.numpy()
    state = kalman.start(box[:, 0], 1.0, parameters.scatter, 0.3)
    state = kalman.update(kalman.predict(state, 2.0, 0.1), box[:, 1], 2.0, parameters.scatter)
    state[1, ::2, kalman.SEEN] = 1.0  # the first scene has no lost targets
    scenes = [
        SceneState(3.0, 0.3, 4e-5, 0.1, 0.05, (500.0, 500.0)),
        SceneState(3.0, 0.2, 1e-5, 0.2, 0.1, (400.0, 300.0)),
    ]
    missed = 2.0 - state[..., kalman.SEEN]
    at_rest = np.zeros((1, *state.shape[:2], 2))
    more = (at_rest,) if scores is newborn_scores else ()
    rows = zip(state, missed, box[:, 2], scenes, strict=True)
    wanted = [scores(BoxLook.of(*row, parameters), parameters, *(part[:, 0] for part in more)) for row in rows]
    together = {name: torch.tensor([[getattr(scene, name)] for scene in scenes]).double() for name in LEARNED}
    size: Any = torch.tensor([scene.size for scene in scenes]).double().T[..., None].unbind()
    tensors: Any = [torch.as_tensor(part) for part in (state, missed, box[:, 2])]
    look = BoxLook.of(tensors[0], tensors[1], tensors[2], SceneState(**together, size=size), parameters)
    found = scores(look, parameters, *(torch.as_tensor(part) for part in more))
    near = np.isfinite(wanted)
    assert near.mean() > 0.5 and (found.numpy()[~near] < -4).all()
    np.testing.assert_allclose(found.numpy()[near], np.stack(wanted)[near], rtol=0, atol=1e-5)


@pytest.mark.parametrize("place", range(len(NAMES)), ids=NAMES)
def test_slopes_are_those_of_small_changes(place: int):
    stretches, start = walkers(3, 5), [value.detach() for value in Parameters(Settings(), NAMES).values().values()]

    def lost(value: Tensor) -> Tensor:
        return link_nll(track(dict(zip(NAMES, start, strict=True)) | {NAMES[place]: value}), stretches, 5, 1.0).sum()

    parameter = start[place].clone().requires_grad_()
    (slope,) = torch.autograd.grad(lost(parameter), parameter)
    more, less = (lost(start[place] * (1 + sign * 1e-4)).item() for sign in (1, -1))
    assert slope.item() == pytest.approx((more - less) / (2e-4 * start[place].item()), rel=0.05, abs=2e-4)


def test_neither_the_order_of_targets_nor_empty_places_matter():
    stretches = walkers()
    wanted = link_nll(Settings().track, stretches, 5, 1.0)
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    of_targets = ("box_px", "there", "certain", "begins", "visible")
    mixed = {name: getattr(stretches, name)[:, :, order] for name in of_targets}
    torch.testing.assert_close(link_nll(Settings().track, replace(stretches, **mixed), 5, 1.0), wanted)
    wider = {name: torch.cat([getattr(stretches, name)] * 2, 2) for name in of_targets}
    for name in ("there", "certain", "begins"):
        wider[name][:, :, 6:] = False
    wider["likeness"] = torch.full((2, 10, 12, 12), torch.nan, dtype=torch.float64)
    torch.testing.assert_close(link_nll(Settings().track, replace(stretches, **wider), 5, 1.0), wanted)


def test_a_pan_that_is_known_costs_nothing():
    stretches = walkers(4, 6, hide=False)
    stretches.box_px[..., :2] += 5e5  # far from the border
    pan = torch.eye(3, dtype=torch.float64).repeat(2, 6, 1, 1)
    pan[:, 1:, 0, 2] = 150.0
    moved = stretches.box_px.clone()
    moved[..., 0] += 150.0 * torch.arange(6)[None, :, None]
    size = torch.full((2, 2), 1e6, dtype=torch.float64)
    still, unknown, known = (
        link_nll(Settings().track, replace(stretches, size=size, **changed), 5, 1.0)
        for changed in ({}, {"box_px": moved}, {"box_px": moved, "motion": pan})
    )
    torch.testing.assert_close(known, still)
    assert (unknown > known + 0.3).all()


def test_own_targets_are_scored_with_their_own_scatter():
    stretches, shipped = walkers(), Settings().track
    own = {name: getattr(shipped, f"own_{name}") for name in ("scatter", "size_scatter")}
    found = link_nll(shipped, replace(stretches, own=torch.ones(2, dtype=torch.bool)), 5, 1.0)
    torch.testing.assert_close(found, link_nll(shipped.model_copy(update=own), stretches, 5, 1.0))
