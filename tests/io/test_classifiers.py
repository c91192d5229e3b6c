"""Linear SVMs from files: the same weights in every format, and a line that says what does not fit."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.people.classifiers import load_classifier, read_classifier

WEIGHTS = np.array([0.5, -1.25, 3.0, 0.0, 2.0, -0.75], np.float32)
BIAS = -0.5


def write(folder, name, content):
    path = folder / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        np.save(path, content)
    return path


def test_the_shipped_classifier_is_opencvs_default_people_detector():
    svm = load_classifier(PeopleParameters())
    theirs = np.ravel(cv2.HOGDescriptor.getDefaultPeopleDetector())
    assert PeopleParameters().features == 3780
    np.testing.assert_allclose(np.append(svm.weights, svm.bias), theirs, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("parameters", "length"),
    [
        ({"window_width_px": 32, "window_height_px": 64}, 3 * 7 * 36),
        ({"block_stride_px": 16}, 4 * 8 * 36),
        ({"block_stride_px": 4}, 13 * 29 * 36),
        ({"bins": 18, "signed": True}, 7 * 15 * 72),
    ],
)
def test_the_length_of_a_descriptor_is_opencvs(parameters, length):
    made = PeopleParameters(**parameters)
    window, stride = (made.window_width_px, made.window_height_px), (made.block_stride_px,) * 2
    theirs = cv2.HOGDescriptor(window, (16, 16), stride, (8, 8), made.bins).getDescriptorSize()
    assert made.features == theirs == length


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", "# weights, then the bias\n0.5\n-1.25\n3 # the third\n0\n2\n-0.75\n\n-0.5\n"),
        ("b.csv", "0.5, -1.25, 3, 0, 2, -0.75, -0.5"),
        ("c", "\ufeff.5 -1.25 3e0 0 2 -.75; -.5"),
        ("d.npy", np.append(WEIGHTS, BIAS)),
        ("e.npy", np.append(WEIGHTS, BIAS).astype(np.float64)[None]),
        ("f.npz", {"weights": WEIGHTS, "bias": BIAS}),
        ("g.npz", {"weights": WEIGHTS[:, None], "bias": np.array([BIAS]), "window": (64, 128), "comment": 3}),
    ],
)
def test_a_classifier_is_the_same_in_every_format(tmp_path, name, content):
    svm = read_classifier(write(tmp_path, name, content), 6, {"window": (64, 128)})
    np.testing.assert_array_equal(svm.weights, WEIGHTS)
    assert svm.weights.dtype == np.float32
    assert (svm.bias, svm.origin) == (BIAS, str(tmp_path / name))
    bare = read_classifier(write(tmp_path, "w.txt", "1 2 3"), 3)
    assert (bare.weights.tolist(), bare.bias) == ([1, 2, 3], 0)


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_what_opencvs_descriptor_saves_is_read_with_its_layout(tmp_path, ending):
    parameters = PeopleParameters(window_width_px=32, window_height_px=64, classifier=str(tmp_path / f"hog.{ending}"))
    numbers = np.random.default_rng(0).normal(size=parameters.features + 1).astype(np.float32)
    theirs = cv2.HOGDescriptor((32, 64), (16, 16), (8, 8), (8, 8), 9, 1, -1, 0, 0.2, True)
    theirs.setSVMDetector(numbers)
    theirs.save(parameters.classifier)
    svm = load_classifier(parameters)
    np.testing.assert_allclose(np.append(svm.weights, svm.bias), numbers, rtol=1e-6)
    with pytest.raises(InputError, match=r"clip of 0\.2, but the settings say 0\.3; change people\.clip"):
        load_classifier(parameters.model_copy(update={"clip": 0.3}))


@pytest.mark.parametrize("kind", [cv2.ml.SVM_C_SVC, cv2.ml.SVM_NU_SVC, cv2.ml.SVM_EPS_SVR])
@pytest.mark.parametrize("labels", [(-1, 1), (0, 1)])
def test_a_linear_svm_of_cv2_ml_scores_people_above_the_rest_as_opencv_does(tmp_path, kind, labels):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(120, 6)).astype(np.float32)
    people = points @ WEIGHTS > 0.7
    answers = np.where(people, labels[1], labels[0])
    theirs = cv2.ml.SVM.create()
    theirs.setType(kind)
    theirs.setKernel(cv2.ml.SVM_LINEAR)
    theirs.setC(1)
    theirs.setNu(0.2)
    theirs.setP(0.1)
    regression = kind == cv2.ml.SVM_EPS_SVR
    theirs.train(points, cv2.ml.ROW_SAMPLE, answers.astype(np.float32 if regression else np.int32))
    theirs.save(str(tmp_path / "svm.xml"))
    svm = read_classifier(tmp_path / "svm.xml", 6)
    score = points @ svm.weights + svm.bias
    raw = theirs.predict(points, flags=cv2.ml.STAT_MODEL_RAW_OUTPUT)[1].ravel()
    np.testing.assert_allclose(score, raw if regression else -raw, atol=1e-4)
    assert ((score > (np.mean(labels) if regression else 0)) == people).mean() > 0.9


BROKEN_ZIP = b"PK\x03\x04" + b"\0" * 40
KERNEL = "%YAML:1.0\n---\nsvm:\n   svmType: C_SVC\n   kernel:\n      type: RBF\n   support_vectors:\n      - [ 1. ]\n"
SVM = KERNEL.replace("RBF", "LINEAR") + "   decision_functions:\n      -\n         sv_count: 1\n"
HOG = "%YAML:1.0\n---\nhog: !!opencv-object-detector-hog\n"


@pytest.mark.parametrize(
    ("name", "content", "wanted"),
    [
        ("w.txt", "", ["is empty", "6 weights"]),
        ("w.txt", "1 2 3\n4 five\n", ["line 2", "'five' is not a number"]),
        ("w.txt", "1 2 3\n4 nan 6", ["line 2", "'nan'", "finite"]),
        ("w.txt", "1 2 3 4 5 1e60", ["number 6 is inf", "finite"]),
        ("w.txt", "1 2 3 4 5", ["has 5 numbers", "settings has 6", "people.window_width_px"]),
        ("w.txt", b"\xff\xfe\x00\x01", ["is not text"]),
        ("w.npy", np.full(6, np.inf), ["number 1 is inf", "finite"]),
        ("w.npy", np.array(["a"] * 6), ["holds <U1", "wanted numbers"]),
        ("w.npy", np.ones(9), ["has 9 numbers", "settings has 6"]),
        ("w.npy", b"not an array", ["NumPy's format"]),
        ("w.npz", BROKEN_ZIP, ["broken"]),
        ("w.npz", {"coefficients": WEIGHTS}, ["holds coefficients", "wanted weights"]),
        ("w.npz", {"weights": WEIGHTS, "bias": np.ones(2)}, ["bias of 2 numbers", "wanted one"]),
        ("w.npz", {"weights": WEIGHTS, "window": "tall"}, ["window is of type"]),
        (
            "w.npz",
            {"weights": WEIGHTS, "window": (32, 64)},
            ["window of 32 x 64", "64 x 128", "people.window_width_px"],
        ),
        ("w.npz", {"weights": WEIGHTS, "signed": True}, ["signed of true", "settings say false", "people.signed"]),
        ("w.yml", "1 2 3", ["not a file that OpenCV saved"]),
        ("w.yml", "%YAML:1.0\n---\nother: 3\n", ["neither an SVMDetector"]),
        ("w.yml", KERNEL, ["kernel RBF", "linear"]),
        ("w.yml", SVM, ["lacks alpha"]),
        ("w.yml", SVM + "         alpha: [ 1., 2. ]\n         rho: 0.5\n", ["broken", "do not fit"]),
        ("w.yml", SVM + "         alpha: [ 1. ]\n         rho: 0.5\n         index: [ 7 ]\n", ["does not hold"]),
        ("w.yml", SVM.partition("   decision")[0] + "   decision_functions: 3\n", ["broken", "do not fit"]),
        ("w.yml", HOG + "   winSize: [ 1, 2, 3 ]\n   SVMDetector: [ 1. ]\n", ["broken", "do not fit"]),
        ("w.txt", "1_0 2 3 4 5 6", ["line 1", "'1_0' is not a number"]),
        ("w.xml", "<html></html>", ["OpenCV"]),
    ],
)
def test_a_mistake_gets_one_line_that_says_what_to_do(tmp_path, name, content, wanted, capfd):
    path = write(tmp_path, name, content)
    with pytest.raises(InputError) as error:
        read_classifier(path, 6, PeopleParameters().descriptor)
    for part in [str(path), *wanted]:
        assert part in str(error.value)


def test_a_file_that_is_absent_or_a_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no classifier or file is named 'absent'; give opencv"):
        read_classifier("absent", 6)
    with pytest.raises(InputError, match="cannot be read: File name too long"):
        read_classifier("x" * 300, 6)
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_classifier(tmp_path, 6)
