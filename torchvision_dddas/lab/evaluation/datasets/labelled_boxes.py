"""Data sets with boxes and identities as truth: VisDrone-MOT, UAVDT, Stanford Drone, PETS 2009 and CAVIAR."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.foreign_boxes import VISDRONE
from torchvision_dddas.lab.evaluation.datasets import files
from torchvision_dddas.lab.evaluation.datasets.annotations import boxes_of_corners, table_of, truth_of
from torchvision_dddas.lab.evaluation.datasets.record import Clip, Reader
from torchvision_dddas.lab.evaluation.metrics.text_rows import FARTHEST, LAST, read_columns, read_text, to_number
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

_CORNER_AND_SIZE = ("left", "top", "width", "height")


class VisDrone(Reader):
    """VisDrone-MOT: road users seen from drones over Chinese cities.

        SPLIT/sequences/NAME/0000001.jpg   pictures, from 1
        SPLIT/annotations/NAME.txt         frame,id,left,top,width,height,counts,category,truncation,occlusion

    Categories count from 1; 0 and 11 (others) are unlabelled regions.
    """

    kind = "visdrone"
    layout = "VisDrone-MOT: sequences/ and annotations/ of a split, or a folder of splits"
    terms = "academic research only"
    categories = VISDRONE
    defaults: ClassVar = {"classes": list(categories)}
    words: ClassVar = {"classes": ("VisDrone", categories)}

    def _places(self) -> Mapping[str, Path]:
        splits = [self.folder, *(self.folder / name for name in files.folders_in(self.folder))]
        splits = [split for split in splits if (split / "annotations").is_dir()]
        if not splits:
            return self._refuse(
                f"{self.folder} holds no annotations/; wanted a split of VisDrone-MOT, or a folder of them"
            )
        places = {path.stem: path for split in splits for path in sorted((split / "annotations").glob("*.txt"))}
        for split in splits:
            self._report_unlabelled(files.folders_in(split / "sequences"), places, f"{split / 'annotations'}/{{}}.txt")
        return places

    def _clip(self, name: str, place: Path) -> Clip:
        home = place.parents[1] / "sequences" / name
        pictures = files.check_numbering(files.images_in(home), 1)
        rows = read_columns(place, ("frame", "identity", *_CORNER_AND_SIZE, "counts", "category"))
        rows.check_known("category", range(12), "0 to 11")
        is_region = np.isin(rows["category"], (0, 11))
        other, rows = rows.at(is_region), rows.at(~is_region)
        regions = TrackTable.of(other["frame"], other["identity"], other.stack(*_CORNER_AND_SIZE))
        table = table_of(place, rows["frame"], rows["identity"], rows.stack(*_CORNER_AND_SIZE), rows.line)
        category = np.array(self.categories)[rows["category"].astype(int) - 1]
        counts = np.isin(category, self.options["classes"]) & (rows["counts"] != 0)
        uncounted = "categories 0 (regions) and 11 (others), rows marked 0, and classes beyond `classes` do not count"
        truth = truth_of(place, table, counts, len(pictures), regions, uncounted)
        return self._boxes_clip(name, place, pictures, truth, home)


class Uavdt(Reader):
    """UAVDT, the benchmark of many targets (UAV-benchmark-M): vehicles seen from a drone.

        UAV-benchmark-M/M0101/img000001.jpg                pictures, from 1, 30 a second
        UAV-benchmark-MOTD_v1.0/GT/M0101_gt_whole.txt      frame,id,left,top,width,height,out-of-view,occlusion,category
                                   M0101_gt_ignore.txt     frame,id,left,top,width,height,...: regions without labels
        M_attr/train or test/M0101_attr.txt                a line of 0 and 1, one for each attribute

    GT may also lie beside the sequences.
    """

    kind = "uavdt"
    layout = "UAVDT of many targets: UAV-benchmark-M/ and UAV-benchmark-MOTD_v1.0/GT/"
    terms = "research only"
    categories = ("car", "truck", "bus")
    attributes = (
        *("daylight", "night", "fog", "low-alt", "medium-alt", "high-alt"),
        *("front-view", "side-view", "bird-view", "long-term"),
    )
    defaults: ClassVar = {"classes": list(categories), "attributes": []}
    words: ClassVar = {"classes": ("UAVDT", categories), "attributes": ("UAVDT's sequences", attributes)}

    def _places(self) -> Mapping[str, Path]:
        whole, folder = "_gt_whole.txt", self.folder
        homes = [folder / name for name in ("UAV-benchmark-MOTD_v1.0/GT", "UAV-benchmark-M/GT", "GT", ".")]
        truths = next((home for home in homes if any(home.glob(f"*{whole}"))), None)
        if truths is None:
            return self._refuse(
                f"{folder} holds no UAV-benchmark-MOTD_v1.0/GT/M0101{whole}; wanted the truth of UAVDT there"
            )
        places = {path.name.removesuffix(whole): path for path in sorted(truths.glob(f"*{whole}"))}
        sequences = folder / "UAV-benchmark-M"
        named = files.folders_in(sequences if sequences.is_dir() else folder)
        named = [name for name in named if name[:1] == "M" and name[1:].isdecimal()]
        self._report_unlabelled(named, places, f"{truths}/{{}}{whole}")
        asked = set(self.options["attributes"])
        return {n: p for n, p in places.items() if not asked or (self.wanted(n) and asked <= self._attributes(n))}

    def _attributes(self, name: str) -> set[str]:
        """Return the attributes of a sequence. Errors in their file go to `missing`."""
        paths = [self.folder / "M_attr" / part / f"{name}_attr.txt" for part in ("train", "test", ".")]
        path = next(filter(Path.is_file, paths), None)
        if path is None:
            self.missing.append(f"{name}: no attributes; they belong in {paths[0]}")
            return set()
        try:
            cells = read_text(path).replace(",", " ").split()
        except InputError as error:
            self.missing.append(f"{name}: {error}")
            return set()
        if len(cells) != len(self.attributes) or not set(cells) <= {"0", "1"}:
            wanted = f"{len(self.attributes)} times 0 or 1: {','.join(self.attributes)}"
            self.missing.append(f"{name}: {path} does not hold {wanted}")
            return set()
        return {attribute for attribute, cell in zip(self.attributes, cells, strict=True) if cell == "1"}

    def _clip(self, name: str, place: Path) -> Clip:
        homes = [self.folder / home / name for home in ("UAV-benchmark-M", "UAVDT_Benchmark_M", ".", "..")]
        pictures = files.check_numbering(next((found for home in homes if (found := files.images_in(home))), ()), 1)
        columns = ("frame", "identity", *_CORNER_AND_SIZE)
        rows = read_columns(place, (*columns, "out-of-view", "occlusion", "category"))
        rows.check_known("category", range(1, len(self.categories) + 1), f"1 to {len(self.categories)}")
        table = table_of(place, rows["frame"], rows["identity"], rows.stack(*_CORNER_AND_SIZE), rows.line)
        counts = np.isin(np.array(self.categories)[rows["category"].astype(int) - 1], self.options["classes"])
        beside, regions = place.with_name(f"{name}_gt_ignore.txt"), None
        if beside.is_file():
            ignored = read_columns(beside, columns)
            regions = TrackTable.of(ignored["frame"], ignored["identity"], ignored.stack(*_CORNER_AND_SIZE))
        truth = truth_of(place, table, counts, len(pictures), regions)
        return self._boxes_clip(name, place, pictures, truth, homes[0], rate_hz=30.0)


class StanfordDrone(Reader):
    """Stanford Drone: people, bicycles and carts on a campus, from straight above.

        annotations/SCENE/VIDEO/annotations.txt   id xmin ymin xmax ymax frame lost occluded generated "label"
        videos/SCENE/VIDEO/video.mov              (or .mp4)

    or folders of any names with annotations.txt, and a video if there is one. Frames count from 0. Lost rows lie
    outside the picture and are left out; occluded and generated (interpolated) ones count.
    """

    kind = "sdd"
    layout = "Stanford Drone: annotations/SCENE/VIDEO/annotations.txt, with the videos if there are any"
    terms = "CC BY-NC-SA 3.0"
    labels = ("Pedestrian", "Biker", "Skater", "Cart", "Car", "Bus")
    defaults: ClassVar = {"classes": list(labels)}
    words: ClassVar = {"classes": ("Stanford Drone", labels)}
    file = "annotations.txt"

    def _places(self) -> Mapping[str, Path]:
        places = {}
        for place in files.find_below(self.folder, lambda place: (place / self.file).is_file(), 3):
            parts = place.relative_to(self.folder).parts
            parts = parts[1:] if parts[:1] == ("annotations",) else parts
            places["-".join(parts) or place.resolve().name] = place
        return places or self._refuse(
            f"{self.folder} holds no {self.file}; wanted annotations/SCENE/VIDEO/{self.file} in it"
        )

    def _clip(self, name: str, place: Path) -> Clip:
        # The video lies beside the annotations, or under videos/ as published.
        top = place.parents[1] if len(place.parents) > 1 else place
        published = top.parent / "videos" / place.parent.name / place.name if top.name == "annotations" else place
        video = (files.videos_in(place) or files.videos_in(published))[:1]
        corners, path = ("xmin", "ymin", "xmax", "ymax"), place / self.file
        columns = ("identity", *corners, "frame", "lost", "occluded", "generated", "label")
        rows = read_columns(path, columns, "label", first=0)
        rows = rows.at(rows["lost"] == 0)
        boxes = boxes_of_corners(rows.stack(*corners))
        table = table_of(path, rows["frame"] + 1, rows["identity"], boxes, rows.line)
        rows.check_known("label", self.labels, ", ".join(self.labels))
        truth = truth_of(path, table, np.isin(rows["label"], self.options["classes"]), files.count_frames(video))
        return self._boxes_clip(name, place, video, truth, place)


class Cvml(Reader):
    """CVML: the annotation of PETS 2009 and CAVIAR as XML.

        NAME.xml    <dataset><frame number="0"><objectlist><object id="1"><box h="" w="" xc="" yc=""/></object>...

    with the pictures in a folder of the XML's name beside it, or in the XML's own folder: frame_0000.jpg ..., or a
    video. Frames count from 0; xc, yc is the middle of a box. Other XML, such as a camera's calibration, is skipped.
    """

    kind = "cvml"
    layout = "PETS 2009 and CAVIAR as CVML: NAME.xml, with pictures in NAME/ if there are any"
    terms = "research only; cite PETS 2009 or CAVIAR"
    defaults: ClassVar = {"rate_hz": None}

    def _places(self) -> Mapping[str, tuple[Path, ...]]:
        paths = {path.stem: path for path in self._annotations_below(self.folder, 2)}
        parents = [path.parent for path in paths.values()]
        places = {}
        for name, path in paths.items():
            is_alone = parents.count(path.parent) == 1
            places[name] = (path, path.with_suffix(""), *([path.parent] if is_alone else []))
        return places or self._refuse(
            f"{self.folder} holds no CVML annotation; wanted NAME.xml with <dataset><frame number=...>"
        )

    def _annotations_below(self, folder: Path, depth: int) -> list[Path]:
        xml = [path for path in sorted(folder.iterdir()) if path.suffix.lower() == ".xml" and path.is_file()]
        found = [path for path in xml if _may_be_cvml(path)]
        return found + [
            p for n in files.folders_in(folder) if depth for p in self._annotations_below(folder / n, depth - 1)
        ]

    def _clip(self, name: str, place: tuple[Path, ...]) -> Clip:
        path, *homes = place
        images = next((found for home in homes if (found := files.images_in(home))), ())
        video = next((found[:1] for home in homes if (found := files.videos_in(home))), ())
        pictures = files.check_numbering(images, files.number_of(images[0]) or 0) if images else video
        length = files.count_frames(pictures)
        v = _read_cvml(path)
        table = table_of(path, v[:, 0] + 1, v[:, 1], v[:, 2:], np.arange(1, len(v) + 1))
        truth = truth_of(path, table, np.ones(len(v), bool), length)
        rate_hz = self.options["rate_hz"]
        return self._boxes_clip(name, path, pictures, truth, homes[0], rate_hz=rate_hz, shows=("people",))


def _may_be_cvml(path: Path) -> bool:
    """Return whether an XML file may be an annotation: broken files too, to report them, but not calibrations."""
    try:
        with path.open("rb") as file:
            beginning = file.read(4096)
    except OSError:
        return True
    return b"<dataset" in beginning or b"<Camera" not in beginning


def _read_cvml(path: Path) -> np.ndarray:
    """Return (N, 6) frame from 0, identity, x, y, width, height. Raise InputError with file and frame."""
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} is broken XML: {error}") from None

    def number_in(element: ElementTree.Element, key: str, where: str) -> float:
        value = to_number(text := element.get(key, ""))
        if not abs(value) <= FARTHEST:
            raise InputError(f"{path}: {element.tag} of {where} has {key}='{text}'; wanted a number")
        return value

    rows = []
    for frame in root.iter("frame"):
        number = number_in(frame, "number", "a frame")
        where = f"frame {number:g}"
        if number != int(number) or not 0 <= number < LAST:
            raise InputError(f"{path}: a frame has the number {number:g}; wanted a whole number, 0 to {LAST - 1}")
        for target in frame.iterfind("objectlist/object"):
            identity, box = number_in(target, "id", where), target.find("box")
            if box is None or identity != int(identity):
                raise InputError(f"{path}: object {identity:g} of {where} has no box or no whole id")
            xc, yc, w, h = (number_in(box, key, where) for key in ("xc", "yc", "w", "h"))
            rows.append([number, identity, xc - w / 2, yc - h / 2, w, h])
    if not rows:
        raise InputError(f"{path} holds no box; wanted <dataset><frame number=...><objectlist><object id=...><box ...>")
    return np.array(rows)
