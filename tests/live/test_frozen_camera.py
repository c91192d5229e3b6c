"""A camera that gives the same picture again and again."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.live.frozen_camera import FrozenCamera
from torchvision_dddas.types import Detections, Frame, FrameResult, TrackedFrame, Tracks

PICTURE = np.zeros((48, 64), np.uint8)


def results(shifts_px, rate_hz=10.0):
    """Results of pictures that shift by so much; None repeats the picture before."""
    for k, shift_px in enumerate(shifts_px):
        motion = np.eye(3)
        motion[0, 2] = shift_px or 0.0
        yield FrameResult(
            TrackedFrame(
                k + 1, Frame(k + 1, k / rate_hz, PICTURE), Detections(), Tracks(k + 1),
                now_from_before=motion, repeats=k if shift_px is None else 0,
            )
        )  # fmt: skip


def told(shifts_px, rate_hz=10.0):
    camera, words = FrozenCamera(), []
    for result in results(shifts_px, rate_hz):
        camera.add(result)
        words.append(camera.describe())
    return words


def test_a_picture_that_stays_the_same_is_reported_until_a_new_one_comes():
    moving, frozen = [0.4] * 40, [None, None, None, 0.004] * 12
    words = told([*moving, *frozen, *moving])
    assert not any(words[: 40 + 29]) and not any(words[40 + 48 :])
    assert words[40 + 47] == "the camera has given the same picture for 5 s: it may be frozen"


def test_a_landed_camera_a_fixed_one_a_slow_clip_and_a_pause_are_not_frozen():
    settling = [None, None, None, 0.008] * 3  # the noise of the first still pictures looks like repeats
    assert not any(told([*[0.4] * 40, *settling, *[0.008] * 100]))
    assert not any(told([None, None, None, 0.0] * 40))
    assert not any(told([0.4, None, None, None] * 40))
    assert not any(told([*[0.4] * 40, *[None, 0.0] * 10], rate_hz=0.5))


def test_an_unknown_motion_is_not_still():
    lost = [TrackedFrame(k, Frame(k, k / 10, PICTURE), Detections(), Tracks(k)) for k in range(41, 101)]
    for motion in (None, np.full((3, 3), np.nan)):
        camera = FrozenCamera()
        for result in [*results([0.4] * 40), *(FrameResult(replace(one, now_from_before=motion)) for one in lost)]:
            camera.add(result)
            assert camera.describe() == ""
