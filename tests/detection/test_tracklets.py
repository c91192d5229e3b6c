"""Small, fast, rarely seen targets are found by their tracklets, and what stays or flickers is not."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.functional.conftest import draw_texture
from torchvision_dddas.config import load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.detection.candidates import Candidates, find_candidates, overlaps
from torchvision_dddas.detection.opencv_engine import OpenCVEngine
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.detection.tracklet_scores import BLOB_SIZED, choose
from torchvision_dddas.detection.tracklets import follow
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.telemetry import read_telemetry

HEIGHT, WIDTH = 240, 320
LOOKS = range(-4, 3)


def film(places, frames=12, size=(7, 14), level=235, ground=None):
    """Pictures of ground that drifts by 2 px a frame, with a bright figure at places(k) of the ground, where it is."""
    ground = draw_texture(3, HEIGHT + 80, WIDTH + 80) // 2 if ground is None else ground
    images = []
    for k in range(frames):
        image = ground[2 * k : 2 * k + HEIGHT, 2 * k : 2 * k + WIDTH].copy()
        for u, v in places(k):
            image[int(v) - 2 * k :, int(u) - 2 * k :][: size[1], : size[0]] = level
        images.append(cv2.GaussianBlur(image, (3, 3), 0))
    return images


def found_at(scene, box):
    """Whether a detection overlaps the box by a quarter."""
    return bool((overlaps(scene.detections.box_px, np.array([box], float)) > 0.25).any())


def candidates(*boxes):
    """Candidates of these boxes, alike in all else."""
    count = len(boxes)
    box, one = np.array(boxes, float).reshape(-1, 4), np.ones(count)
    patch = np.tile(np.eye(1, 144), (count, 1))
    evidence = np.ones((count, 4)), np.zeros((count, 4))
    return Candidates(box, np.zeros(count, int), one, 9 * one, *evidence, patch, 0 * one)


def seen(at, boxes_at, camera=(0.0, 0.0)):
    """The looks about one, at offsets in looks; the ground is `camera` further in each."""
    shifted = {o: [(x + o * camera[0], y + o * camera[1], w, h) for x, y, w, h in boxes_at(o)] for o in at}
    move = {o: np.array([[1, 0, -o * camera[0]], [0, 1, -o * camera[1]], [0, 0, 1.0]]) for o in at}
    return {o: (candidates(*shifted[o]), move[o]) for o in at if o}


def test_people_who_go_further_than_their_own_size_between_looks_are_found():
    """As they show in a few pictures a second from 60 m: each step is longer than the person is wide."""
    images = film(lambda k: [(60 + 15 * k, 90 + 2 * k), (280 - 13 * k, 180)])
    scenes = list(detect_motion(images))
    hits = [
        (found_at(scene, (60 + 13 * k, 90, 7, 14)), found_at(scene, (280 - 15 * k, 180 - 2 * k, 7, 14)))
        for k, scene in enumerate(scenes)
    ]
    assert np.mean(hits[1:-1]) > 0.9
    assert np.mean([len(scene.detections) for scene in scenes]) < 3.5


def test_the_box_of_a_small_target_is_as_large_as_the_target():
    """Erosion takes a pixel from each side of a candidate; the target gets it back."""
    images, ground = [], draw_texture(3, HEIGHT + 80, WIDTH + 80) // 2
    for k in range(12):
        images.append(ground[2 * k : 2 * k + HEIGHT, 2 * k : 2 * k + WIDTH].copy())
        images[-1][90:118, 60 + 13 * k : 80 + 13 * k] = 170
    sizes = [scene.detections.box_px[:, 2:] for scene in detect_motion(images, backend="onboard")]
    width, height = np.median(np.concatenate(sizes[2:-2]), axis=0)
    assert width >= 20 and height >= 28


def test_what_stands_still_and_what_flickers_is_no_target():
    rng = np.random.default_rng(1)
    spots = rng.uniform((30, 30), (300, 220), (20, 2))
    images = film(lambda k: [(150, 120), *spots[rng.random(len(spots)) < 0.05]], size=(4, 4), level=140)
    assert np.mean([len(scene.detections) for scene in detect_motion(images)]) < 0.3


def test_each_side_of_a_cut_is_searched_to_its_ends():
    one = film(lambda k: [(60 + 15 * k, 90)], 6)
    two = film(lambda k: [(250 - 15 * k, 150)], 6, ground=draw_texture(9, HEIGHT + 80, WIDTH + 80) // 2)
    scenes = list(detect_motion(one + two))
    boxes = [(60 + 13 * k, 90 - 2 * k, 7, 14) for k in range(6)]
    boxes += [(250 - 17 * k, 150 - 2 * k, 7, 14) for k in range(6)]
    assert np.mean([found_at(*pair) for pair in zip(scenes, boxes, strict=True)]) > 0.8


def test_a_restless_part_of_the_picture_hides_nothing_beside_it():
    """Bare trees that shimmer over most of a picture, and a walker on a clean road beside them."""
    rng = np.random.default_rng(0)
    images = film(lambda k: [(40 + 3 * k, 40 + 6 * k)], size=(9, 18), level=160)
    for image in images:
        image[:, 130:] = np.clip(image[:, 130:] + rng.normal(0, 45, (HEIGHT, WIDTH - 130)), 0, 255)
    scenes = list(detect_motion(images))
    assert np.mean([found_at(s, (40 + k, 40 + 4 * k, 9, 18)) for k, s in enumerate(scenes)]) > 0.7


def test_silhouettes_show_small_and_large_things_that_one_of_them_would_not():
    evidence = np.zeros((200, 300), np.uint8)
    evidence[40:54, 50:57] = 160  # small
    evidence[100:180, 150:170] = evidence[100:180, 190:210] = 160  # two halves of something large and even
    found = find_candidates((evidence, None, evidence, evidence), np.zeros_like(evidence), [])
    wanted = np.array([(50, 40, 7, 14), (150, 100, 60, 80)], float)
    assert (overlaps(found.box_px, wanted).max(axis=0) > 0.6).all()
    assert len(find_candidates((None,) * 4, np.zeros_like(evidence), [])) == 0
    assert len(find_candidates((evidence * 0, None, None, None), np.zeros_like(evidence), [])) == 0


@pytest.mark.parametrize("camera", [(0.0, 0.0), (7.0, -4.0)])
def test_a_tracklet_follows_its_target_over_the_ground(camera):
    mover = (100.0, 80.0, 8.0, 16.0)
    looks = seen(LOOKS, lambda o: [(20, 20, 8, 16), (100 + 12 * o, 80 - 3 * o, 8, 16)], camera)
    tracklets = follow(candidates((20, 20, 8, 16), mover), looks, (400, 400))
    np.testing.assert_allclose(tracklets.velocity_px, [[0, 0], [12, -3]], atol=1e-6)
    assert tracklets.hits.tolist() == [7, 7] and all(tracklets.members[o].tolist() == [0, 1] for o in looks)
    np.testing.assert_allclose(tracklets.travel_px, [0, 6 * np.hypot(12, 3)], atol=1e-6)
    assert tracklets.sureness[1] > 20 > tracklets.sureness[0]
    np.testing.assert_allclose([tracklets.growth_x, tracklets.growth_y, tracklets.stays], 0, atol=1e-9)


def test_something_that_stays_where_a_mover_is_seen_speaks_against_it():
    looks = seen(LOOKS, lambda o: [(100 + 12 * o, 80, 8, 16), (100, 80, 8, 16)])
    assert follow(candidates((100, 80, 8, 16)), looks, (400, 400)).hits[0] == 7
    moving = seen(LOOKS, lambda o: [(100 + 12 * o, 80, 8, 16), (130, 80, 8, 16)])
    there = follow(candidates((100, 80, 8, 16), (130, 80, 8, 16)), moving, (400, 400))
    assert there.stays[0] == 0


def test_without_other_looks_a_candidate_is_its_own_tracklet():
    alone = follow(candidates((10, 10, 5, 5)), {}, (100, 100))
    assert alone.hits.tolist() == [1] and np.isfinite(alone.sureness).all()
    assert len(follow(candidates(), {}, (100, 100)).hits) == 0
    empty = follow(candidates((10, 10, 5, 5)), {1: (candidates(), np.eye(3))}, (100, 100))
    assert empty.hits.tolist() == [1] and empty.members[1].tolist() == [-1]


def test_of_overlapping_candidates_the_likeliest_is_the_target():
    found = candidates((0, 0, 30, 30), (2, 2, 10, 10), (16, 16, 10, 10), (60, 60, 10, 10))
    blob = replace(found, silhouette=np.array([-1, 0, 0, 0]), inside=9 * found.inside)
    scores = np.array([0.5, 1.0, 0.8, -5.0])
    assert choose(found, scores, 0.0, 25) == [1, 2]
    assert choose(blob, scores, 0.0, 25) == [0]
    # One that is narrower than the closing is left out, or taken where nothing else is.
    assert choose(blob, scores, 0.0, 50) == [1, 2]
    assert choose(blob, scores, 0.0, 50, BLOB_SIZED) == [1, 2]
    assert choose(blob, np.array([-1.0, -1, -1, -5]), 0.0, 50, BLOB_SIZED) == [0]
    # To be a blob is evidence by itself.
    assert choose(blob, np.full(4, -1.0), 0.0, 25) == [0]
    assert choose(candidates(), np.zeros(0), 0.0, 25) == []


@pytest.mark.parametrize(("between", "wanted"), [(1.0, [1, 2]), (4.0, [0])])
def test_a_blob_that_joins_two_people_gives_way_to_them_where_background_shows_between_them(between, wanted):
    """A car whose ends alone stand out is one thing: what lies between them moves too."""
    box = np.array([(0, 0, 60, 60), (2, 5, 16, 50), (40, 5, 16, 50)], float)
    evidence = np.array([9.0, 9.0, 9.0])
    evidence[0] = (2 * 9 * 800 + between * (3600 - 1600)) / 3600
    found = candidates(*box)
    found = replace(found, silhouette=np.array([-1, 0, 0]), inside=np.tile(evidence[:, None], 4))
    assert sorted(choose(found, np.array([1.0, 0.9, 0.8]), 0.0, 25)) == wanted


@pytest.mark.parametrize("backend", ["onboard", "torch"])
def test_a_mask_leaves_regions_out(tmp_path, backend):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 200:] = 255
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    images = film(lambda k: [(60 + 9 * k, 90), (240 + 5 * k, 180)])
    settings = load_config(None, [f'difference.ignore="{tmp_path / "mask.png"}"'])
    scenes = list(detect_motion(images, settings, backend))
    assert any(len(scene.detections) for scene in scenes)
    assert all(scene.mask[:, 215:].max() == 0 for scene in scenes)
    with pytest.raises(InputError, match=r"mask\.png has 320x240 pixels and the frames 160x120"):
        list(detect_motion([image[:120, :160] for image in images], settings, backend))
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask | 255)
    with pytest.raises(InputError, match="has no black pixel"):
        list(detect_motion(images, settings, backend))


def test_each_frame_of_a_batch_has_the_mask_of_its_own_settings(tmp_path):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 200:] = 255
    assert cv2.imwrite(str(tmp_path / "mask.png"), mask)
    images = film(lambda k: [(60 + 9 * k, 90), (240 + 5 * k, 180)])
    whole, masked = load_config(None), load_config(None, [f'difference.ignore="{tmp_path / "mask.png"}"'])
    scenes = list(
        detect_motion(images, whole, "torch", batch=8, retune=lambda frame: (masked if frame.number > 6 else whole, ()))
    )
    shown = [bool(scene.mask[:, 215:].any()) for scene in scenes]
    assert any(shown[:6]) and not any(shown[6:])


def test_points_carried_into_a_region_that_is_left_out_are_let_go():
    """Else those that pass below burnt-in text stay with the text."""
    engine = OpenCVEngine(load_config(None))
    views = [engine.prepare(image) for image in film(lambda _: [], 3)]
    for view in views:
        view.ignored = np.zeros((HEIGHT, WIDTH), np.uint8)
        view.ignored[60:120] = 255
    for pair in pairwise(views):
        assert engine.register([pair])[0].reliable
        carried = pair[1].carried
        assert carried is not None
        points = carried.points
        rows = points[:, 1].round()
        assert len(points) > 20 and not ((rows >= 60) & (rows < 120)).any()


def test_a_thin_line_that_is_left_out_is_left_out_at_half_the_resolution():
    view = OpenCVEngine(load_config(None)).prepare(film(lambda _: [], 1)[0])
    view.ignored = np.zeros((HEIGHT, WIDTH), np.uint8)
    view.ignored[31] = view.ignored[:, 45] = 255
    half = view.half.ignored
    assert half is not None and half[15].all() and half[:, 22].all()
    assert (half > 0).sum() == HEIGHT // 2 + WIDTH // 2 - 1


def test_tracklets_may_be_switched_on_and_off_where_the_device_finds_blobs():
    """A window may be looked at after the settings of its frame have been replaced."""
    images = film(lambda k: [(60 + 15 * k, 90 + 2 * k), (280 - 13 * k, 180)])
    on, off = load_config(None), load_config(None, ["tracklets.on=false"])
    for one, other in ((on, off), (off, on)):
        engine = TorchEngine(one, components="torch")
        retune = lambda frame, one=one, other=other: (other if 4 <= frame.number < 9 else one, ())  # noqa: E731
        scenes = list(detect_motion(images, one, engine, batch=1, retune=retune))
        assert len(scenes) == len(images) and any(len(scene.detections) for scene in scenes)


def test_a_list_of_pictures_may_come_with_telemetry(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time_s,altitude_m,speed_mps\n0,60,3\n1,60,3\n2,60,3\n")
    scenes = list(detect_motion(film(lambda k: [(60 + 15 * k, 90)]), telemetry=read_telemetry(log)))
    assert any(len(scene.detections) for scene in scenes)


def test_engines_agree_on_the_targets_of_tracklets():
    images = film(lambda k: [(60 + 15 * k, 90 + 2 * k), (280 - 13 * k, 180)])
    one, other = (list(detect_motion(images, None, backend)) for backend in ("onboard", "torch"))
    found = [[scene.detections.box_px for scene in scenes] for scenes in (one, other)]
    assert sum(map(len, found[0])) > 15
    shared = sum((overlaps(*pair) > 0.7).any(axis=1).sum() for pair in zip(*found, strict=True))
    assert shared > 0.9 * max(sum(map(len, boxes)) for boxes in found)
