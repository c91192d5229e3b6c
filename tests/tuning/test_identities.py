"""Examples of true links from clips, and the family that tunes on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import TrackTable, Truth
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.tracking import track_table
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.tuning import tracking
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.examples import stack_padded
from torchvision_dddas.tuning.family import load_family
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.tracking import Stretches, TrackingFamily
from torchvision_dddas.types import Detections

PERSON = np.array([20.0, 50.0])


def walk(name: str = "walk", people: int = 4, frames: int = 150, seed: int = 0, true: bool = True) -> Clip:
    """People who walk about for a while."""
    draw = np.random.default_rng(seed)
    place = draw.uniform(100, 400, (people, 2)) + np.cumsum(draw.normal(0, 0.5, (frames, people, 2)), axis=0).cumsum(0)
    frame = np.repeat(np.arange(1, frames + 1), people)
    identity = np.tile(np.arange(1, people + 1), frames)
    box_px = np.concatenate([place.reshape(-1, 2) - PERSON / 2, np.tile(PERSON, (len(frame), 1))], axis=1)
    table = TrackTable(frame, identity, box_px)
    truth = Truth("boxes", Path(name), {}, {int(f): box_px[frame == f] for f in np.unique(frame)}, table)
    return Clip(name, Path(name), truth=truth if true else None)


def seen(clip: Clip, place: Path, false: int = 1, miss: float = 0.1, seed: int = 1) -> Clip:
    """The clip with public detections: some people missed, boxes that scatter, and false alarms in each frame."""
    draw = np.random.default_rng(seed)
    assert clip.truth is not None
    lines = []
    for frame, boxes in clip.truth.boxes.items():
        for x, y, width, height in boxes[draw.uniform(size=len(boxes)) >= miss] + draw.normal(0, 0.5, (1, 4)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},{width:.2f},{height:.2f},{draw.choice([0.8, 0.99, 1.0])}")
        for x, y in draw.uniform(-200, 700, (false, 2)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},20,50,{draw.choice([0.8, 0.99])}")
    path = place / f"{clip.name}.txt"
    path.write_text("\n".join(lines) + "\n")
    return replace(clip, given=path)


def test_a_clip_becomes_stretches_of_its_looks_in_order_each_with_a_loss():
    family, settings, told = TrackingFamily(interval=5), Settings(), []
    examples = family.examples([walk()], settings, lambda: told.append(1))
    assert [example.frame for example in examples] == [1, 1 + 5 * tracking.FRAMES]
    assert [example.clip for example in examples] == ["walk", "walk"]
    assert len(told) == 2
    values = Parameters(settings, ["track.scatter", "track.prior"]).values()
    losses = family.loss(values, examples, 1.0)
    assert losses.shape == (2,)
    assert (losses > 0).all()
    alone = torch.cat([family.loss(values, [example], 1.0) for example in examples])
    torch.testing.assert_close(losses, alone, rtol=0, atol=1e-4)


def test_what_the_tracker_knows_of_a_look_is_what_the_tracker_itself_knows(monkeypatch: pytest.MonkeyPatch):
    """Pace and births, where it links as is true."""
    clip, settings, seen = walk(people=6, frames=100), Settings(), []
    plain = ScoreTracker._scene

    def sight(self, look):
        seen.append((look.frame, self.speed_prior.speed, plain(self, look).birth_rate))
        return plain(self, look)

    monkeypatch.setattr(ScoreTracker, "_scene", sight)
    assert clip.truth is not None
    assert clip.truth.tracks is not None
    (example,) = TrackingFamily(interval=5).examples([clip], settings)
    width, height = example.content.arrays["size"].tolist()
    tracker = ScoreTracker(settings, 5, (width, height))
    for number in range(1, 101, 5):
        box = clip.truth.boxes[number]
        one = np.ones(len(box))
        tracker.feed(number, Detections(box, one, one, one * np.nan, one * np.nan))
    tracker.end()
    looks = example.content.arrays
    speeds = {frame: speed for frame, speed, _ in seen}
    births = {frame: rate for frame, _, rate in seen}
    from torchvision_dddas.tracking.scores import blend_speed

    found = [blend_speed(settings.track.speed, *pair) for pair in zip(looks["usual"], looks["known"], strict=True)]
    assert found == pytest.approx([speeds[int(frame)] for frame in looks["frame"]])
    assert looks["births"].tolist() == pytest.approx([births[int(frame)] for frame in looks["frame"]])


def test_stretches_of_several_sizes_are_filled_up_with_nobody():
    family = TrackingFamily(interval=5)
    examples = family.examples([walk("a", 3, 60), walk("b", 5, 40, seed=1)], Settings())
    looks = stack_padded(Stretches, [example.content.arrays for example in examples], pad="edge")
    assert looks.there.shape == (2, 12, 5)
    assert looks.there.sum((1, 2)).tolist() == [36, 40]


def test_a_clip_without_identities_is_refused_by_name():
    with pytest.raises(InputError, match="nobody has no true identities"):
        TrackingFamily().examples([walk("nobody", true=False)], Settings())


def test_knobs_that_the_sources_association_never_asks_are_refused():
    settings = with_parameters(Settings(), {"track.mode": "paper"})
    with pytest.raises(InputError, match=r"no effect under track\.mode=paper; add --set track.mode=default"):
        TrackingFamily().check(["track.speed"], settings)
    TrackingFamily().check(["track.speed"], Settings())


def test_the_family_is_found_by_its_name_and_takes_the_interval_of_a_study():
    family = load_family("tracking")
    assert family.at(5, "association").examples([walk()], Settings())[0].content.arrays["interval"] == 5


def test_the_task_says_whether_true_boxes_or_detections_are_learned_from(tmp_path: Path):
    clip, settings = seen(walk(), tmp_path), Settings()
    family = TrackingFamily()
    true = family.at(5, "association").examples([clip], settings)[0].content.arrays
    found = family.at(5, "tracking").examples([clip], settings)[0].content.arrays
    assert true["there"].all()
    assert true["doubt"].max() == 0
    assert family.at(5, "tracking").measure == "tracking.tracks.idf1"
    assert found["doubt"].min() > 0
    assert (found["certain"] <= found["there"]).all()
    assert (found["begins"] <= found["there"]).all()
    assert found["certain"].sum() < found["begins"].sum() < found["there"].sum()
    # Four people who are missed now and then, and one false alarm a look.
    assert sorted(found["there"].sum(0).tolist())[-5:][0] == 1
    assert found["there"].sum(1).max() == 5


def test_births_and_doubt_of_detections_are_those_of_the_tracker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Doubt is; births are where false alarms have no part in it."""
    clip, settings, told = seen(walk(people=6, frames=100), tmp_path, false=0), Settings(), []
    plain = ScoreTracker._scene

    def sight(self, look):
        told.append((look.frame, plain(self, look)))
        return plain(self, look)

    monkeypatch.setattr(ScoreTracker, "_scene", sight)
    (example,) = TrackingFamily().at(5, "tracking").examples([clip], settings)
    assert clip.given is not None
    for _ in track_table(read_detections(clip.given), settings, 5):
        pass
    # Of a look ahead less is counted: the last of each look is its own.
    of = dict(told)
    looks = example.content.arrays
    frames = looks["frame"].astype(int).tolist()
    assert looks["doubt"].tolist() == pytest.approx([of[frame].doubt for frame in frames])
    assert looks["births"].tolist() == pytest.approx([of[frame].birth_rate for frame in frames])


def test_detections_are_wanted_by_name_where_there_are_none(tmp_path: Path):
    with pytest.raises(InputError, match="walk has no public detections"):
        TrackingFamily().at(5, "tracking").examples([walk()], Settings())
    settings = Settings().model_copy(update={"track": Settings().track.model_copy(update={"min_score": 1.0})})
    path = tmp_path / "faint.txt"
    path.write_text("1,-1,10,10,20,50,0.5\n")
    with pytest.raises(InputError, match="no box of score 1 or more"):
        TrackingFamily().at(5, "tracking").examples([replace(walk(), given=path)], settings)


def test_links_to_false_alarms_are_never_true(tmp_path: Path):
    """A prior that lets everything be linked costs more where there are false alarms to link."""
    family, lax = TrackingFamily().at(5, "tracking"), Settings()
    lax = lax.model_copy(update={"track": lax.track.model_copy(update={"prior": 12.0})})
    losses = []
    for false in (0, 6):
        clip = seen(walk(), tmp_path, false)
        of = [
            family.loss(Parameters(s, ["track.tail"]).values(), family.examples([clip], s), 1.0)
            for s in (lax, Settings())
        ]
        losses.append((of[0] - of[1]).mean().item())
    assert losses[1] > losses[0] + 0.1


def test_a_true_link_to_a_detection_is_asked_for_with_a_margin(tmp_path: Path):
    """What is sure anyway has no slope; without a margin false alarms close the gate, with it they do so less."""
    settings, clip = Settings(), seen(walk(), tmp_path, 6)
    family = TrackingFamily().at(5, "tracking")
    slopes = []
    for one in (replace(family, missed=0.0), family):
        parameters = Parameters(settings, ["track.prior"])
        one.loss(parameters.values(), one.examples([clip], settings), 1.0).mean().backward()
        slopes.append(parameters.free[0].grad.item())
    assert family.missed > 0
    assert TrackingFamily().at(5, "association").missed == 0
    assert slopes[1] < slopes[0] - 0.01


def test_a_wrong_parameter_gets_better_by_descending():
    settings = Settings().model_copy(update={"track": Settings().track.model_copy(update={"scatter": 0.5})})
    family = TrackingFamily(interval=5)
    parameters = Parameters(settings, ["track.scatter"])
    done = descend(family, parameters, family.examples([walk()], settings), Plan(6, 2, 0.3, look_every=3))
    assert done.settings.track.scatter < 0.3
    assert not done.failed
