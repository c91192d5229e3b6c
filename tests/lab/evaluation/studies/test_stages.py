"""Each stage finds what its own command finds, and depends on the settings that its key holds and on no others."""

from unittest.mock import patch

import cv2
import numpy as np
import pytest

from tests.lab.evaluation.studies import world
from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.io.images import decode_image
from torchvision_dddas.lab.evaluation.studies import stages
from torchvision_dddas.lab.evaluation.studies.stages import find, narrow_settings, open_clip, true_boxes, upstream_task
from torchvision_dddas.tracking import track_scenes
from torchvision_dddas.tracking.torch_source_tracker import TorchSourceTracker

NOW = load_config()


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "clips"
    world.three(folder)
    return {clip.name: clip for clip in world.clips_in(folder)}


def find_before(clip, task, settings=NOW):
    """What the stage before a task finds, if there is one."""
    need = upstream_task(clip, task)
    return None if need is None else find(clip, need, settings)


def find_all(clip, task, interval=1):
    return find(clip, task, NOW, interval=interval, before=find_before(clip, task))


def test_a_clip_allows_what_its_pictures_and_truth_allow(clips) -> None:
    assert stages.allowed_tasks(clips["masks"]) == ("motion",)
    assert stages.allowed_tasks(clips["tracks"]) == ("motion", "tracking", "association")
    assert stages.allowed_tasks(clips["table"]) == ("tracking", "association")


def test_motion_is_what_the_loop_finds_with_masks_of_labelled_frames(clips) -> None:
    scenes = list(detect_motion(open_clip(clips["masks"]), NOW, "onboard"))
    found = find(clips["masks"], "motion", NOW)
    assert found.looked.tolist() == [scene.frame.number for scene in scenes] and len(found.frame) > 0
    for scene in scenes:
        rows = found.frame == scene.frame.number
        assert (found.box_px[rows] == scene.detections.box_px).all()
        assert (found.score[rows] == scene.detections.score).all()
        mask = decode_image(found.masks[scene.frame.number], cv2.IMREAD_UNCHANGED)
        assert mask is not None and np.array_equal(mask > 0, scene.mask > 0)
    assert sorted(found.masks) == clips["masks"].truth.frames
    assert find(clips["tracks"], "motion", NOW).masks == {}


@pytest.mark.parametrize("interval", [1, 2])
def test_tracks_of_what_was_kept_are_those_of_a_run_of_the_clip(clips, interval) -> None:
    source = open_clip(clips["tracks"])
    wanted = list(track_scenes(detect_motion(source, NOW, "onboard"), NOW, interval, source.size))
    found = find_all(clips["tracks"], "tracking", interval)
    assert found.looked.tolist() == [frame.number for frame in wanted]
    assert found.identity.tolist() == [i for frame in wanted for i in frame.tracks.identity.tolist()]
    boxes = np.concatenate([frame.tracks.box_px for frame in wanted])
    assert np.abs(found.box_px - boxes).max(initial=0) <= 0.005


def test_the_sources_association_in_torchs_batches_finds_the_same(clips) -> None:
    paper, compute = load_config("paper"), TorchSourceTracker._affinities
    with patch.object(TorchSourceTracker, "_affinities", autospec=True, side_effect=compute) as batches:
        onboard, torch = (find(clips["tracks"], "association", paper, backend) for backend in ("onboard", "torch"))
    assert len(onboard.identity) and onboard.identity.tolist() == torch.identity.tolist()
    assert batches.called


def test_a_picture_that_cannot_be_read_stays_out_of_the_tracks_too(tmp_path) -> None:
    world.followed(tmp_path, "tracks", 2)
    (clip,) = world.clips_in(tmp_path)
    clip.pictures[3].write_bytes(b"no picture")
    scenes = list(detect_motion(open_clip(clip), NOW, "onboard"))
    found = find(clip, "motion", NOW)
    assert any("could not be decoded" in note for note in found.notes)
    for scene, again in zip(scenes, stages.replay_scenes(clip, found), strict=True):
        assert (scene.frame.image == again.frame.image).all() and scene.frame.number == again.frame.number
        assert np.array_equal(scene.detections.middle_px, again.detections.middle_px, equal_nan=True)
        assert (scene.step is not None and scene.step.reliable) == (again.step is not None)


def test_a_clip_without_pictures_has_tracks_of_its_tables_each_interval_th_frame(clips) -> None:
    assert set(find_all(clips["table"], "tracking").identity.tolist()) - {-1}
    found = find_all(clips["table"], "association", interval=2)
    assert found.looked.tolist() == [1, 3, 5, 7, 9]
    assert set(found.frame.tolist()) <= {1, 3, 5, 7, 9}


def test_the_order_of_true_boxes_does_not_reveal_their_identities(clips) -> None:
    table, true_px = true_boxes(clips["table"], 1), clips["table"].truth.tracks.box_px
    assert sorted(map(tuple, table.box_px.tolist())) == sorted(map(tuple, true_px.tolist()))
    assert not (table.box_px == true_px).all()
    assert (table.score == 1).all() and table.identity is None


READ: set[str] = set()


class Watched(Settings):
    """Settings that note which of their groups are read."""

    def __getattribute__(self, name):
        if name in Settings.model_fields:
            READ.add(name)
        return super().__getattribute__(name)


@pytest.mark.parametrize(
    ("task", "mode"), [("motion", "default"), ("tracking", "default"), ("tracking", "paper"), ("association", "paper")]
)
def test_a_stage_reads_no_settings_but_those_in_its_key(clips, monkeypatch, task, mode) -> None:
    clip, settings = clips["tracks"], load_config(None, [f"track.mode={mode}"])
    before = find_before(clip, task, settings)
    monkeypatch.setattr(stages, "narrow_settings", lambda settings, task: Watched.model_validate(settings.model_dump()))
    find(clip, task, settings, before=before)
    READ.clear()
    find(clip, task, settings, before=before)
    assert set(stages.PARAMETER_GROUPS[task]) >= READ > set()


def test_a_stage_is_given_the_defaults_of_other_groups() -> None:
    settings = load_config(None, ["track.memory_frames=7", "difference.threshold=4.0"])
    assert narrow_settings(settings, "motion").track == Settings().track
    assert narrow_settings(settings, "motion").difference.threshold == 4.0
    assert narrow_settings(settings, "association").track.memory_frames == 7
