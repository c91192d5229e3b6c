"""Training on pictures of one's own: what is trained finds again what it was trained for, and mistakes get a line."""

import sys

import cv2
import numpy as np
import pytest

pytest.importorskip("sklearn")
pytest.importorskip("torch")

from export import train_people as script
from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.people.classifiers import load_classifier, read_classifier
from torchvision_dddas.people.detector import load_scorer
from torchvision_dddas.people.pyramid import everywhere, windows
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.types import LinearSvm, Part

CHANGED = {"window_width_px": 32, "window_height_px": 64, "scale_step": 1.2, "enlarge": 1.0}
SMALL = PeopleParameters(**CHANGED)
SET = ["--set", *(f"people.{name}={value}" for name, value in CHANGED.items())]


def background(rng, size):
    """Blurred noise with a few lines."""
    image = cv2.GaussianBlur(rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8), (0, 0), 3)
    image = np.interp(image, (image.min(), image.max()), (40, 215)).astype(np.uint8)
    for _ in range(8):
        a, b = rng.integers(0, size, 2), rng.integers(0, size, 2)
        cv2.line(image, tuple(map(int, a)), tuple(map(int, b)), tuple(map(int, rng.integers(0, 255, 3))), 2)
    return image


def stick(image, feet, height, rng):
    """A stick person with legs apart, arms, and a head, dark or bright."""
    x, y = feet
    colour = tuple(int(v) for v in rng.integers(0, 30, 3) + (225 if rng.random() < 0.5 else 0))
    stride, arm = (rng.uniform(0.1, 0.18) * height for _ in range(2))
    hip, neck, hand = (x, y - 0.45 * height), (x, y - 0.8 * height), y - rng.uniform(0.4, 0.5) * height
    for start in ((x - stride, y), (x + stride, y), neck):
        line(image, start, hip, colour, height / 12)
    for side in (-arm, arm):
        line(image, neck, (x + side, hand), colour, height / 12)
    cv2.circle(image, (round(x), round(y - 0.9 * height)), max(2, round(height / 10)), colour, -1)


def line(image, start, end, colour, thick):
    cv2.line(image, tuple(map(round, start)), tuple(map(round, end)), colour, max(1, round(thick)))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Crops of 64 x 96 px with stick people of 48 px in the middle 32 x 64, and pictures without any."""
    place, rng = tmp_path_factory.mktemp("train"), np.random.default_rng(0)
    for name, count, size in (("people", 40, (64, 96)), ("rest/deeper", 10, (160, 120))):
        (place / name).mkdir(parents=True)
        for k in range(count):
            image = background(rng, size)
            if name == "people":
                stick(image, (32, 16 + 56), 48, rng)
            cv2.imwrite(str(place / name / f"{k:02d}.png"), image)
    return place


def train(folders, out, *words, people="people"):
    """The script's exit code."""
    given = [folders / people, folders / "rest", "--crop", "32x64", "--windows", 300, "--out", out, *SET, *words]
    return script.main([str(word) for word in given])


@pytest.fixture(scope="module")
def trained(folders):
    assert train(folders, folders / "stick.npz", "--quiet") == 0
    return folders / "stick.npz"


@pytest.mark.slow
def test_what_was_trained_finds_people_again_in_other_pictures(trained):
    rng, size = np.random.default_rng(99), (160, 120)
    parameters = SMALL.model_copy(update={"classifier": str(trained)})
    recognizer, parts = load_scorer(parameters, "torch"), everywhere(size, parameters)
    right = 0
    for _ in range(10):
        image = background(rng, size)
        x, height = int(rng.integers(30, 130)), int(rng.integers(50, 70))
        stick(image, (x, 100), height, rng)
        scored = windows(parts, recognizer.scores([image], [parts])[0], size, parameters)
        found = people_from_windows(*scored, size, parameters)
        if len(found):
            u, v = found.feet_px[0]
            right += abs(u - x) < 12 and abs(v - 100) < 16
    assert right >= 8


@pytest.mark.slow
def test_the_same_pictures_and_seed_give_the_same_numbers_as_text_too(folders, trained, capsys):
    assert train(folders, folders / "stick.txt") == 0
    output = capsys.readouterr().out
    for part in ("C = ", "round 1: ", "held out: ", "--set people.classifier=", "people.window_width_px=32"):
        assert part in output
    one, other = (read_classifier(path, 756) for path in (trained, folders / "stick.txt"))
    np.testing.assert_array_equal(one.weights, other.weights)
    assert one.bias == pytest.approx(other.bias, rel=1e-6)


def test_the_file_tells_its_layout(trained):
    with pytest.raises(InputError, match=r"window of 32 x 64, but the settings say 64 x 128"):
        load_classifier(PeopleParameters(classifier=str(trained)))


@pytest.mark.parametrize("parameters", [SMALL, PeopleParameters(bins=18, signed=True, block_stride_px=4, gamma=False)])
def test_descriptors_under_the_weights_are_the_recognizers_scores(parameters):
    rng, stride = np.random.default_rng(1), parameters.window_stride_px
    image = background(rng, (200, 170))
    size = parameters.window_width_px, parameters.window_height_px
    weights = rng.normal(size=parameters.features).astype(np.float32)
    parts = everywhere((200, 170), parameters)
    maps = load_scorer(parameters, "torch", LinearSvm(weights, 0.5)).scores([image], [parts])[0]
    places, wanted = [], []
    for part, scores in zip(parts[::2], maps[::2], strict=True):
        for row, column in {(0, 0), (scores.shape[0] - 1, scores.shape[1] - 1)}:
            places.append(Part(part.level, part.x + column * stride, part.y + row * stride, *size))
            wanted.append(scores[row, column])
    found = script.descriptors(np.stack(script.cut(image, places)), parameters) @ weights + 0.5
    np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_descriptors_are_opencvs():
    window = background(np.random.default_rng(2), (66, 130))
    theirs = np.ravel(cv2.HOGDescriptor().compute(window, winStride=(8, 8), locations=[(1, 1)]))
    np.testing.assert_allclose(script.descriptors(window[None], PeopleParameters())[0], theirs, atol=1e-5)


def error_line(capsys, *words):
    assert script.main([str(word) for word in words]) == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("people", "rest", "out", "line"),
    [
        ("absent", "rest", "svm.npz", "is no folder"),
        ("people", "empty", "svm.npz", "empty holds no images"),
        ("broken", "rest", "svm.npz", "a.png cannot be decoded"),
        ("people", "rest", "empty", "is a folder; give the name of a file"),
        ("people", "rest", "none/svm.npz", "cannot write"),
        ("people", "rest", "people/0.png", "among the pictures"),
    ],
)
def test_a_mistake_in_the_folders_gets_one_line(folders, capsys, people, rest, out, line):
    for name in ("empty", "broken"):
        (folders / name).mkdir(exist_ok=True)
    (folders / "broken" / "a.png").write_bytes(b"no picture")
    assert line in error_line(capsys, folders / people, folders / rest, "--out", folders / out)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--crop", "100x200"), "smaller than --crop 100x200"),
        (("--crop", "wide"), "wanted width x height"),
        (("--set", "people.window_width_px=256", "--set", "people.window_height_px=512"), "less than half the window"),
        ((), "none of 10 pictures is as large as the window"),
        (("--held-out", 2), "--held-out is 2"),
        (("--c", -1), "--c is -1"),
        (("--seed", -1), "--seed is -1; wanted 0 or more"),
        (("--windows", 10**9), "--windows is 1000000000"),
    ],
)
def test_a_mistake_in_the_options_gets_one_line(folders, tmp_path, capsys, words, line):
    out = tmp_path / "svm.npz"
    assert line in error_line(capsys, folders / "people", folders / "rest", "--out", out, *words)
    assert not out.exists()


def test_too_few_to_choose_c_by_are_refused(folders, capsys):
    (folders / "two").mkdir()
    for path in sorted((folders / "people").glob("*.png"))[:2]:
        (folders / "two" / path.name).write_bytes(path.read_bytes())
    assert train(folders, folders / "two.npz", "--windows", 1, people="two") == 2
    assert "too few to choose C by" in capsys.readouterr().err


def test_without_scikit_learn_the_extra_is_named(folders, tmp_path, capsys, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "sklearn"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    assert train(folders, tmp_path / "svm.npz") == 2
    assert "pip install 'torchvision-dddas[torch,train]'" in capsys.readouterr().err
