"""What commands say of clips."""

from torchvision_dddas.cli.progress import clip_names


def test_clip_names_are_telling_and_different():
    names = clip_names(
        ["a/walk/frames", "b/walk/frames/", "x.mp4", "run/*.png", "camera:0", "rtsp://host/cam.1", "frames"]
    )
    assert names == ["walk", "walk-2", "x", "run", "camera-0", "cam", "frames"]
