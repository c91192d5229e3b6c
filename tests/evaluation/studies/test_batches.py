"""Clips that go through a back end together: each gives what it gives alone, to the last digit."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection.detector import run
from torchvision_dddas.detection.engine import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.batches import find_motion_together, scenes_together
from torchvision_dddas.evaluation.studies.record import Found
from torchvision_dddas.evaluation.studies.stages import find
from torchvision_dddas.simulation.scene import render
from torchvision_dddas.types import Frame, Scene

RATE_HZ = 10.0
SIZE = (176, 132)


class Film:
    """A source of frames at hand; breaks off with an error after `whole` of them."""

    rate_hz = RATE_HZ

    def __init__(self, images: Sequence[np.ndarray], whole: int | None = None) -> None:
        self.images, self.whole = images, whole

    def __iter__(self):
        for i, image in enumerate(self.images):
            if i == self.whole:
                raise InputError("the clip breaks off")
            yield Frame(i + 1, i / RATE_HZ, image)


@pytest.fixture(scope="module", params=["onboard", "torch"])
def backend(request) -> str:
    if request.param == "torch":
        torch = pytest.importorskip("torch")
        torch.set_num_threads(1)
    return request.param


@pytest.fixture(scope="module")
def films() -> dict[str, list[np.ndarray]]:
    """Of several lengths, one with a cut, one of another size."""
    kept = {f"film {seed}": render(seed=seed, frames=8 + 2 * seed, size=SIZE).images for seed in range(2)}
    kept["cut"] = [*kept["film 0"][:4], *kept["film 1"][:4]]
    kept["small"] = [np.ascontiguousarray(image[:100, :160]) for image in kept["film 0"]]
    return kept


def settings_of(config: str | None) -> Settings:
    return (
        load_config(config)
        if config != "long intervals"
        else with_parameters(load_config(), {"interval.frames": 4, "small.on": True})
    )


def digits(scene: Scene) -> tuple[bytes | float | str | int, ...]:
    """All that a scene holds, to the last digit; its times are not a part of it."""
    d, step = scene.detections, scene.step
    tables = (scene.mask, d.box_px, d.score, d.area_px, d.heading_rad, d.speed_px, scene.core)
    told = () if step is None else (step.later_from_earlier.tobytes(), step.tracked, step.inliers, step.error_px)
    return (scene.frame.number, scene.interval_frames, scene.cause, *told, *(np.asarray(t).tobytes() for t in tables))


def together(films, settings, backend, batch=None) -> dict[str, list]:
    found: dict[str, list] = {name: [] for name in films}
    clips = {name: Film(images) for name, images in films.items()}
    for name, scene in scenes_together(clips, load_engine(backend, settings), settings, batch=batch):
        if isinstance(scene, Scene):
            found[name].append(digits(scene))
    return found


def alone(films, settings, backend, batch) -> dict[str, list]:
    return {
        name: [digits(s) for s in run(Film(images), load_engine(backend, settings), settings, batch=batch)]
        for name, images in films.items()
    }


@pytest.mark.parametrize("config", ["fast", "source", "long intervals"])
def test_clips_together_give_what_each_gives_alone_whatever_the_batch_and_order(config, films, backend) -> None:
    if backend == "onboard" and config != "fast":
        pytest.skip("this back end takes one window after the other")
    settings = settings_of(config)
    wanted = alone(films, settings, backend, 1)
    assert sum(len(scenes) for scenes in wanted.values()) == sum(len(images) for images in films.values())
    backwards = dict(reversed(films.items()))
    assert together(films, settings, backend) == wanted
    assert together(backwards, settings, backend, batch=3) == wanted
    if backend == "torch":
        assert alone(films, settings, backend, 8) == wanted


def test_a_clip_that_breaks_off_or_is_too_short_leaves_the_others_alone(films, backend) -> None:
    settings, images = load_config("fast"), films["film 1"]
    clips = {"whole": Film(images), "broken": Film(images, whole=5), "short": Film(images[:2])}
    said = list(scenes_together(clips, load_engine(backend, settings), settings))
    ends = {name: end for name, end in said if not isinstance(end, Scene)}
    assert ends["whole"] is None
    assert str(ends["broken"]) == "the clip breaks off" and "2 frames" in str(ends["short"])
    found = [digits(scene) for name, scene in said if name == "whole" and isinstance(scene, Scene)]
    assert found == alone({"whole": images}, settings, backend, 1)["whole"]


def test_what_the_back_end_took_is_shared_out_among_the_clips(films, backend) -> None:
    settings = load_config("fast")
    clips = {name: Film(images) for name, images in films.items()}
    scenes = [scene for _, scene in scenes_together(clips, load_engine(backend, settings), settings)]
    observed = [s for s in scenes if isinstance(s, Scene) and s.reliable and "register" in s.seconds]
    assert len(observed) > 20
    assert all(s.seconds["register"] > 0 and s.seconds["foreground"] > 0 for s in observed)


def test_no_clip_gives_nothing(backend) -> None:
    assert list(scenes_together({}, load_engine(backend, load_config()), load_config())) == []


def on_disk(place: Path, images: Sequence[np.ndarray]) -> Clip:
    """A clip as a data set has it, with a mask as the truth of its third and fourth frame."""
    place.mkdir()
    for i, image in enumerate(images, 1):
        cv2.imwrite(str(place / f"{i:06d}.png"), image)
    masks = {frame: place / f"{frame:06d}.png" for frame in (3, 4)}
    return Clip(place.name, place, tuple(sorted(place.glob("*.png"))), truth=Truth("masks", place, masks, {}))


def test_clips_of_a_study_are_found_together_as_each_alone(films, backend, tmp_path) -> None:
    clips = [on_disk(tmp_path / name.replace(" ", "_"), images) for name, images in films.items()]
    together = find_motion_together(clips, load_config("fast"), backend)
    assert list(together) == [clip.name for clip in clips]
    for clip in clips:
        one, other = find(clip, "motion", load_config("fast"), backend), together[clip.name]
        assert isinstance(other, Found)
        for name in ("frame", "box_px", "score", "looked"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert set(one.masks) == {3, 4} and one.masks == other.masks and one.notes == other.notes
        assert {k: v.tobytes() for k, v in one.steps.items()} == {k: v.tobytes() for k, v in other.steps.items()}
        assert {k: v.tobytes() for k, v in one.more.items()} == {k: v.tobytes() for k, v in other.more.items()}
        assert set(one.seconds) == set(other.seconds)


def test_of_a_clip_without_pictures_the_cause_is_told_and_the_others_are_found(films, backend, tmp_path) -> None:
    clips = [Clip("none", tmp_path / "none"), on_disk(tmp_path / "some", films["small"])]
    found = find_motion_together(clips, load_config("fast"), backend)
    assert "no pictures" in str(found["none"]) and isinstance(found["some"], Found)
