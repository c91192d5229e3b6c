"""The source's study of its recognizer: `python eval/people_study.py DATA [--every 16] [--out DIR] [--plot]`.

Window size, block stride and window stride against accuracy and time (appendix A, III-B: a smaller window is faster and
misses more; the stride then compensates). DATA holds people/ (crops with people: INRIA's 96 x 160), moving_camera/ and
textures/ (pictures without people, for training) and association/ with PETS09-S2L1 and TUD-Stadtmitte (truth).

Other windows and block strides than OpenCV's need classifiers of their own: each is trained here, alike, on the crops
(export/train_people.py). Compare those with one another; OpenCV's coefficients learned from far more pictures.
"as it is": the pyramid begins with the picture. "same people": the picture is first resized so that the smallest body
that fits the window has --body px, for every window size. Recall is at one false box a picture, at IoU 0.5, as in
people_miss_rate.py; time is processor time of scoring a picture, on one thread of torch (set OMP_NUM_THREADS=1), the
median ratio to OpenCV's with 64 x 128, 8, 8 on the same people in the same picture, all taken in turn.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1]))
from people_curves import CLIPS, Clip, Found, curve, read

from export.train_people import Plan, crops, train, write
from torchvision_dddas.cli.progress import progress
from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.people.classifiers import load_classifier
from torchvision_dddas.people.pyramid import everywhere, windows
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.people.torch_scorer import TorchScorer
from torchvision_dddas.types import LinearSvm

CROP = (64, 128)  # INRIA's window in its crops
PLAIN = ("bms_cars1", "bms_cars4", "bms_cars6", "davis_car-shadow", "davis_drift-chicane", "uav123_building4")
MOST_WINDOWS = 1500  # the best of a picture: far more than one false box a picture needs
LARGEST = 900  # pictures for training are shrunk to this


@dataclass
class Trial:
    """One setting. size: of the window; block, stride: of blocks and of windows in px; same: the same people."""

    classifier: str
    size: tuple[int, int]
    block: int
    stride: int
    same: bool
    seconds: list[float] = field(default_factory=list)
    found: dict[str, dict[int, Found]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The window's size."""
        return f"{self.size[0]} x {self.size[1]}"

    def parameters(self, step: float) -> PeopleParameters:
        """The settings."""
        return PeopleParameters(
            window_width_px=self.size[0],
            window_height_px=self.size[1],
            block_stride_px=self.block,
            window_stride_px=self.stride,
            scale_step=step,
            enlarge=1.0,
            settle=1.0,  # so that only what is studied differs
        )


SIZES = ((32, 64), (48, 96), (64, 128), (96, 192))


def trials() -> list[Trial]:
    """The first is what the times are relative to."""
    found = [Trial("OpenCV", (64, 128), 8, stride, True) for stride in (8, 4, 16)]
    found += [Trial("OpenCV", (64, 128), 8, 8, False)]
    found += [Trial("trained", size, 8, 8, same) for same in (True, False) for size in SIZES]
    found += [Trial("trained", (64, 128), block, 8, True) for block in (4, 16)]
    found += [Trial("trained", size, 8, 4, True) for size in SIZES[:2]]
    return [*found, Trial("trained", SIZES[0], 4, 4, True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--every", type=int, default=16, help="of the frames that there are")
    parser.add_argument("--step", type=float, default=1.1, help="from level to level of the pyramid")
    parser.add_argument("--body", type=float, default=64.0, help="smallest body of the same people, px")
    parser.add_argument("--c", type=float, default=0.03, help="of the SVMs")
    parser.add_argument("--rounds", type=int, default=2, help="of hard negatives")
    parser.add_argument("--out", type=Path, help="a folder for the classifiers, which are read again, and the plot")
    parser.add_argument("--plot", action="store_true", help="recall against time, people_study.png in --out")
    options = parser.parse_args()
    people = options.data / "people" / "INRIA-96x160-pos"
    if missing := [str(place) for place in (people, options.data / "association" / CLIPS[0]) if not place.is_dir()]:
        sys.exit(f"skipped: {missing[0]} is not there")
    if options.plot and options.out is None:
        sys.exit("--plot needs a folder, --out")
    wanted = trials()
    svms = classifiers(wanted, options, people)
    clips = [read(options.data / "association" / name, options.every) for name in CLIPS]
    clips = run(wanted, svms, clips, options)
    if not clips:
        sys.exit("no picture was seen by every setting; nothing was measured")
    print("\n".join(table(wanted, clips)))
    if options.plot:
        plot(wanted, clips, options.out / "people_study.png")


def classifiers(
    wanted: list[Trial], options: argparse.Namespace, people: Path
) -> dict[tuple[str, tuple[int, int], int], LinearSvm]:
    """One for each window size and block stride; those that --out holds from before are read."""
    rest = list(plain(options.data))
    made: dict[tuple[str, tuple[int, int], int], LinearSvm] = {}
    for trial in wanted:
        key, parameters = (trial.classifier, trial.size, trial.block), trial.parameters(options.step)
        if key in made:
            continue
        if trial.classifier == "OpenCV":
            made[key] = load_classifier(parameters)
            continue
        kept = options.out and options.out / f"{trial.size[0]}x{trial.size[1]}_{trial.block}_{options.c:g}.npz"
        if kept and kept.exists():
            made[key] = load_classifier(parameters.model_copy(update={"classifier": str(kept)}))
            continue
        larger = max(1.0, trial.size[1] / CROP[1])  # so that large windows have pictures to be trained on, too
        pictures = [resized(image, larger) for image in rest]
        parameters = parameters.model_copy(update={"window_stride_px": 8})
        trained = train(crops(people, parameters, CROP), pictures, parameters, Plan(c=options.c, rounds=options.rounds))
        made[key] = trained.svm
        print(f"{trial.name}, blocks every {trial.block} px: {trained.lines[-2]}", file=sys.stderr, flush=True)
        if kept:
            kept.parent.mkdir(parents=True, exist_ok=True)
            write(kept, trained.svm, parameters)
    return made


def plain(data: Path) -> Iterator[np.ndarray]:
    """Pictures without people."""
    paths = [path for clip in PLAIN for path in sorted((data / "moving_camera" / clip / "frames").glob("*"))[::14]]
    paths += sorted(path for path in (data / "textures").glob("*") if path.suffix.lower() in (".png", ".jpg"))
    for path in paths:
        image = cv2.imread(str(path))
        if image is not None:
            yield resized(image, min(1.0, LARGEST / max(image.shape)))


def run(
    wanted: list[Trial],
    svms: dict[tuple[str, tuple[int, int], int], LinearSvm],
    clips: list[Clip],
    options: argparse.Namespace,
) -> list[Clip]:
    """Every setting on every picture, in turn; Ctrl-C ends it early. Returns the clips as far as they were seen."""
    recognizers = [
        TorchScorer(trial.parameters(options.step), svms[trial.classifier, trial.size, trial.block]) for trial in wanted
    ]
    try:
        with progress("study", sum(len(clip.frames) for clip in clips), False) as tick:
            for clip, number, image in in_turn(clips):
                for trial, recognizer in zip(wanted, recognizers, strict=True):
                    look(trial, recognizer, clip.name, number, image, options.body)
                tick()
    except KeyboardInterrupt:
        print("stopped; what follows is of the pictures that every setting has seen", file=sys.stderr)
    done = {clip.name: set(wanted[-1].found.get(clip.name, {})) for clip in clips}
    for trial in wanted:
        trial.found = {name: {n: trial.found[name][n] for n in sorted(seen)} for name, seen in done.items() if seen}
        trial.seconds = trial.seconds[: sum(map(len, done.values()))]
    return [
        Clip(clip.name, {n: image for n, image in clip.frames.items() if n in done[clip.name]}, clip.truth)
        for clip in clips
        if done[clip.name]
    ]


def in_turn(clips: list[Clip]) -> list[tuple[Clip, int, np.ndarray]]:
    """All pictures, those of the clips mixed, so that an early end leaves some of each."""
    every = [(i / len(clip.frames), clip, *frame) for clip in clips for i, frame in enumerate(clip.frames.items())]
    return [(clip, number, image) for _, clip, number, image in sorted(every, key=lambda row: row[0])]


def look(trial: Trial, recognizer: TorchScorer, clip: str, number: int, image: np.ndarray, smallest: float) -> None:
    """One setting on one picture."""
    parameters = recognizer.parameters
    factor = parameters.height_share * parameters.window_height_px / smallest if trial.same else 1.0
    begun = time.process_time()
    shown = resized(image, factor)
    size = shown.shape[1::-1]
    parts = everywhere(size, parameters)
    maps = recognizer.scores([shown], [parts])[0]
    trial.seconds.append(time.process_time() - begun)
    every = np.sort(np.concatenate([scores.ravel() for scores in maps]))
    low = parameters.model_copy(update={"threshold": float(every[-MOST_WINDOWS:][0])})
    found = people_from_windows(*windows(parts, maps, size, low), size, low)
    trial.found.setdefault(clip, {})[number] = (found.box_px / factor, found.margin)


def resized(image: np.ndarray, factor: float) -> np.ndarray:
    if factor == 1:
        return image
    size = round(image.shape[1] * factor), round(image.shape[0] * factor)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)


def recall(trial: Trial, clip: Clip) -> tuple[float, float]:
    """At one false box a picture; and its standard error, if people were independent."""
    share = curve(trial.found[clip.name], clip).recall_at(1)
    return share, (share * (1 - share) / people_in(clip)) ** 0.5


def people_in(clip: Clip) -> int:
    return sum(len(clip.truth[number]) for number in clip.frames)


def ratio(trial: Trial, first: Trial) -> float:
    return float(np.median(np.array(trial.seconds) / np.array(first.seconds)))


def table(wanted: list[Trial], clips: list[Clip]) -> list[str]:
    """Markdown."""
    names = [f"{clip.name}, {len(clip.frames)} frames, {people_in(clip)} people" for clip in clips]
    rows = [
        f"| classifier | window, px | block stride | window stride | picture | time | {' | '.join(names)} |",
        "|---|---|---|---|---|---|" + "---|" * len(clips),
    ]
    for trial in wanted:
        shown = ["{:.3f} ± {:.3f}".format(*recall(trial, clip)) for clip in clips]
        picture = "same people" if trial.same else "as it is"
        cells = [trial.classifier, trial.name, trial.block, trial.stride, picture, f"{ratio(trial, wanted[0]):.2f}"]
        rows.append(f"| {' | '.join(map(str, [*cells, *shown]))} |")
    rows.append(f"\n{np.median(wanted[0].seconds):.2f} s of processor time a picture for time 1.")
    return rows


def plot(wanted: list[Trial], clips: list[Clip], path: Path) -> None:
    """Recall against time."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(clips), figsize=(12, 5), sharey=True, layout="constrained")
    for axis, clip in zip(axes, clips, strict=True):
        for trial in wanted:
            at = ratio(trial, wanted[0]), recall(trial, clip)[0]
            mark = ("o" if trial.same else "s") if trial.classifier == "trained" else ("D" if trial.same else "^")
            axis.plot(*at, mark, color=f"C{SIZES.index(trial.size)}")
            axis.annotate(
                f"{trial.size[0]} b{trial.block} w{trial.stride}",
                at,
                fontsize=7,
                xytext=(4, 2),
                textcoords="offset points",
            )
        axis.set(title=clip.name, xlabel="time relative to 64 x 128, 8, 8", xscale="log", ylim=(0, 1))
    axes[0].set_ylabel("recall at one false box a picture")
    figure.suptitle("circle: trained, same people; square: trained, picture as it is; diamond, triangle: OpenCV's")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
