"""Each stage finds what its own command finds, and depends on the settings that its key holds and on no others."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.evaluation.studies import world
from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Source
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.studies.stages import (
    PARAMETER_GROUPS,
    allowed_tasks,
    find,
    narrow_settings,
    open_clip,
    replay_scenes,
    upstream_task,
)
from torchvision_dddas.io.images import decode_image
from torchvision_dddas.tracking import track_scenes


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "clips"
    world.three(folder)
    return {clip.name: clip for clip in read(Source("folder", folder), Path()).clips}


def found_in(clip, task, settings=None, interval=1):
    settings = settings or load_config()
    need = upstream_task(clip, task)
    before = None if need is None else find(clip, need, settings)
    return find(clip, task, settings, interval=interval, before=before)


def test_a_clip_allows_what_its_pictures_and_truth_tell(clips) -> None:
    assert allowed_tasks(clips["masks"]) == ("motion",)
    assert allowed_tasks(clips["tracks"]) == ("motion", "tracking", "association")
    assert allowed_tasks(clips["table"]) == ("tracking", "association")


def test_motion_is_what_the_loop_finds(clips) -> None:
    clip, settings = clips["masks"], load_config()
    scenes = list(detect_motion(open_clip(clip), settings, "onboard"))
    found = find(clip, "motion", settings)
    assert found.looked.tolist() == [scene.frame.number for scene in scenes]
    assert len(found.frame) > 0
    for scene in scenes:
        rows = found.frame == scene.frame.number
        assert (found.box_px[rows] == scene.detections.box_px).all()
        assert (found.score[rows] == scene.detections.score).all()
        mask = decode_image(found.masks[scene.frame.number], cv2.IMREAD_UNCHANGED)
        assert mask is not None and np.array_equal(mask > 0, scene.mask > 0)


def test_masks_are_kept_of_frames_that_the_truth_labels_alone(clips) -> None:
    assert (
        sorted(find(clips["masks"], "motion", load_config()).masks)
        == truths.load_truth(clips["masks"].place / "masks").frames
    )
    assert find(clips["tracks"], "motion", load_config()).masks == {}


@pytest.mark.parametrize("interval", [1, 2])
def test_tracks_of_what_was_kept_are_those_of_a_run_of_the_clip(clips, interval) -> None:
    clip, settings = clips["tracks"], load_config()
    source = open_clip(clip)
    scenes = detect_motion(source, settings, "onboard")
    wanted = list(track_scenes(scenes, settings, interval, source.size))
    found = found_in(clip, "tracking", settings, interval)
    assert found.looked.tolist() == [followed.number for followed in wanted]
    assert found.identity.tolist() == [i for followed in wanted for i in followed.tracks.identity.tolist()]
    boxes = np.concatenate([followed.tracks.box_px for followed in wanted])
    assert np.abs(found.box_px - boxes).max(initial=0) <= 0.005


def test_a_picture_that_cannot_be_read_stays_out_of_the_tracks_too(clips, tmp_path) -> None:
    world.followed(tmp_path / "clips", "tracks", 2)
    (clip,) = read(Source("folder", tmp_path / "clips"), Path()).clips
    clip.pictures[3].write_bytes(b"no picture")
    settings = load_config()
    source = open_clip(clip)
    scenes = list(detect_motion(source, settings, "onboard"))
    found = find(clip, "motion", settings)
    assert any("could not be decoded" in note for note in found.notes)
    for scene, again in zip(scenes, replay_scenes(clip, found), strict=True):
        assert (scene.frame.image == again.frame.image).all() and scene.frame.number == again.frame.number
        assert np.array_equal(scene.detections.middle_px, again.detections.middle_px, equal_nan=True)
        reliable = scene.step is not None and scene.step.reliable
        assert reliable == (again.step is not None)


def test_tracks_without_pictures_are_of_the_given_detections(clips) -> None:
    found = found_in(clips["table"], "tracking")
    assert len(found.frame) and set(found.identity.tolist()) != {-1}


def test_association_looks_at_each_interval_th_frame_alone(clips) -> None:
    found = found_in(clips["table"], "association", interval=2)
    assert found.looked.tolist() == [1, 3, 5, 7, 9]
    assert set(found.frame.tolist()) <= {1, 3, 5, 7, 9}


def test_the_order_of_true_boxes_does_not_tell_who_is_who(clips) -> None:
    from torchvision_dddas.evaluation.studies.stages import true_boxes

    clip = clips["table"]
    table = true_boxes(clip, 1)
    assert sorted(map(tuple, table.box_px.tolist())) == sorted(map(tuple, clip.truth.tracks.box_px.tolist()))
    assert not (table.box_px == clip.truth.tracks.box_px).all()
    assert (table.score == 1).all() and table.identity is None


class Watched(Settings):
    """Settings that note which of their groups are looked at."""

    def __getattribute__(self, name):
        if name in Settings.model_fields:
            LOOKED.add(name)
        return super().__getattribute__(name)


LOOKED: set[str] = set()


@pytest.mark.parametrize("mode", ["default", "paper"])
@pytest.mark.parametrize("task", ["motion", "tracking", "association"])
def test_a_stage_looks_at_no_settings_but_those_in_its_key(clips, monkeypatch, task, mode) -> None:
    from torchvision_dddas.evaluation.studies import stages

    clip, settings = clips["tracks"], load_config(None, [f"track.mode={mode}"])
    need = upstream_task(clip, task)
    before = None if need is None else find(clip, need, settings)
    monkeypatch.setattr(stages, "narrow_settings", lambda settings, task: Watched.model_validate(settings.model_dump()))
    find(clip, task, settings, before=before)
    LOOKED.clear()
    find(clip, task, settings, before=before)
    assert set(PARAMETER_GROUPS[task]) >= LOOKED


def test_a_stage_is_given_the_defaults_of_other_groups() -> None:
    settings = load_config(None, ["track.memory_frames=7", "difference.threshold=4.0"])
    assert narrow_settings(settings, "motion").track == Settings().track
    assert narrow_settings(settings, "motion").difference.threshold == 4.0
    assert narrow_settings(settings, "association").track.memory_frames == 7
