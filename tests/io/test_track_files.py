"""Boxes and places as other programs read and write them."""

import json
import sqlite3
import struct
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.io.track_files import FORMATS, write_tracks
from torchvision_dddas.types import Detections, Frame, Positions, Scene, Tracks

SIZE = (640, 480)
ENDINGS = {"csv": ".csv", "mot": ".txt", "visdrone": ".txt", "coco": ".json", "cvat": ".xml"}
ENDINGS |= {"parquet": ".parquet"}


def tracks(frames=(1, 2, 3, 6), label=("car", "van")):
    one = np.array([[10.0, 20.5, 30.0, 40.0], [200.0, 100.0, 50.0, 60.0]])
    made = []
    for frame in frames:
        box_px = one + np.array([5.0 * frame, 0, 0, 0])
        identity, score = np.array([3, 7]), np.array([0.9, 0.5])
        made.append(Tracks(frame, identity, box_px, score, np.arange(2), label=np.array(label, object)))
    return made


def concat(several) -> Any:
    return Tracks.concat(several)


def places() -> Any:
    degrees = np.array([[-110.95, 32.23], [-110.94, 32.24]])
    unknown = np.full((2, 2, 2), np.nan)
    metres = np.array([[1.0, 2.0], [3.0, 4.0]])
    return Positions(np.array([1, 2]), np.array([5, 5]), metres, unknown, np.ones(2), lonlat_deg=degrees)


@pytest.mark.parametrize("to", FORMATS)
def test_boxes_come_back_from_every_format_with_what_it_holds(to, tmp_path):
    if to == "gpkg":
        pytest.skip("holds places")
    pytest.importorskip("pyarrow") if to == "parquet" else None
    path, given = tmp_path / f"out{ENDINGS.get(to, '')}", concat(tracks())
    write_tracks(tracks(), path, to=to, size=SIZE)
    read: Any = read_detections(path if to != "davis" else path / "masks", size=SIZE)
    holds, at_most = FORMATS[to][1], 0.01 if to != "davis" else 0.51
    assert read.frame.tolist() == given.frame.tolist()
    np.testing.assert_allclose(read.box_px, given.box_px, atol=at_most)
    if "identities" in holds:
        assert read.identity.tolist() == given.identity.tolist()
    if "classes" in holds:
        assert read.label.tolist() == given.label.tolist()
    if "scores" in holds:
        np.testing.assert_allclose(read.score, given.score)


def test_what_a_format_cannot_hold_is_named(tmp_path):
    assert "classes" in write_tracks(tracks(), tmp_path / "a.txt")[0]
    assert "identities" in write_tracks(tracks(), tmp_path / "labels", size=SIZE)[0]
    assert "scores" in write_tracks(tracks(), tmp_path / "a.xml")[0]
    assert "animal" in write_tracks(tracks(label=("car", "animal")), tmp_path / "b.txt", to="visdrone")[0]
    found = Scene(
        Frame(1, 0.0, np.zeros((4, 4), np.uint8)), np.zeros((4, 4)), Detections(np.ones((1, 4)), np.array([0.9])), 1
    )
    with pytest.raises(InputError, match="identity"):
        write_tracks([found], tmp_path / "c.xml")
    with pytest.raises(InputError, match="size"):
        write_tracks([found], tmp_path / "labels")


def test_a_track_of_cvat_ends_where_the_target_was_lost(tmp_path):
    write_tracks(tracks(frames=(1, 2, 5, 6)), tmp_path / "a.xml")
    text = (tmp_path / "a.xml").read_text()
    assert text.count('frame="2" outside="1"') == 2 and text.count('outside="1"') == 2


def test_a_track_of_cvat_has_one_class_with_a_note(tmp_path):
    both = [*tracks(frames=(1,)), *tracks(frames=(2,), label=("bus", "van"))]
    assert "1 tracks change their class: cvat holds one, the first" in write_tracks(both, tmp_path / "a.xml")
    labels = read_detections(tmp_path / "a.xml").label
    assert labels is not None and labels.tolist() == ["car", "van", "car", "van"]


def test_coco_has_the_names_and_the_size_of_the_pictures(tmp_path):
    names = [f"clip_{k}.jpg" for k in range(6)]
    write_tracks(tracks(), tmp_path / "a.json", size=SIZE, pictures=names)
    held = json.loads((tmp_path / "a.json").read_text())
    assert [image["file_name"] for image in held["images"]] == names
    assert {(image["width"], image["height"]) for image in held["images"]} == {SIZE}
    assert read_detections(tmp_path / "a.json").frame.max() == 6


def test_coco_keeps_the_frames_of_pictures_that_are_numbered_otherwise(tmp_path):
    write_tracks(tracks(), tmp_path / "a.json", size=SIZE, pictures=[f"clip_{k}.jpg" for k in range(100, 106)])
    assert np.unique(read_detections(tmp_path / "a.json").frame).tolist() == [1, 2, 3, 6]


@pytest.mark.parametrize(("to", "file"), [("yolo", "000003.txt"), ("davis", "000003.png")])
def test_files_of_other_boxes_are_not_left_beside_new_ones(to, file, tmp_path):
    write_tracks(tracks(), tmp_path, to=to, size=SIZE)
    write_tracks(tracks(), tmp_path, to=to, size=SIZE)
    with pytest.raises(InputError, match=f"holds {file}, which is not of these boxes"):
        write_tracks(tracks(frames=(1, 2)), tmp_path, to=to, size=SIZE)


def test_masks_are_read_from_the_folder_that_was_written(tmp_path):
    write_tracks(tracks(), tmp_path / "out", to="davis", size=SIZE)
    read, masks = read_detections(tmp_path / "out"), read_detections(tmp_path / "out" / "masks")
    assert (
        len(read) > 0 and read.box_px.tolist() == masks.box_px.tolist() and read.frame.tolist() == masks.frame.tolist()
    )
    (tmp_path / "none" / "masks").mkdir(parents=True)
    with pytest.raises(InputError, match="holds no labels"):
        read_detections(tmp_path / "none")


def test_a_table_without_tracks_becomes_empty_masks(tmp_path):
    (tmp_path / "a.csv").write_text("frame,identity,x_px,y_px,width_px,height_px\n")
    write_tracks(read_detections(tmp_path / "a.csv"), tmp_path, to="davis", size=SIZE, pictures=["a.png"])
    assert [file.name for file in (tmp_path / "masks").iterdir()] == ["000001.png"]


@pytest.mark.parametrize(
    ("names", "frames", "lacking"),
    [
        (("a/1.png", "b/1.png"), [1, 2], 1),
        (("7.png", "last.png"), [1, 2], 1),
        (("7.png", "3.png"), [7, 3], 0),
    ],
)
@pytest.mark.parametrize("program", ["coco", "cvat"])
def test_a_note_says_that_the_order_of_pictures_gives_the_frames(program, names, frames, lacking, tmp_path):
    images = [{"id": k, "file_name": name} for k, name in enumerate(names)]
    boxes = [{"image_id": k, "bbox": [9, 9, 5, 5], "score": 0.1 * frame} for k, frame in enumerate(frames)]
    box = "<box label='a' xtl='9' ytl='9' xbr='14' ybr='14'/>"
    text = "".join(f"<image name='{name}'>{box}</image>" for name in names)
    file = tmp_path / {"coco": "a.json", "cvat": "a.xml"}[program]
    coco = json.dumps({"images": images, "annotations": boxes})
    file.write_text(coco if program == "coco" else f"<annotations>{text}</annotations>")
    read: Any = read_detections(file)
    assert read.frame.tolist() == sorted(frames)
    assert [note.partition(" have")[0] for note in read.notes] == [f"{lacking} of 2 pictures"] * bool(lacking)


def test_results_of_a_detector_in_cocos_format_are_read(tmp_path):
    box = {"image_id": 3, "category_id": 2, "bbox": [1, 2, 3, 4], "score": 0.5}
    (tmp_path / "a.json").write_text(json.dumps([box]))
    read: Any = read_detections(tmp_path / "a.json")
    assert (read.frame[0], read.box_px[0].tolist(), read.label[0], read.identity[0]) == (3, [1, 2, 3, 4], "2", -1)
    assert read.notes == ("the file lists no images: each image_id is taken as the number of a frame",)


def test_what_is_left_out_of_other_formats_is_noted(tmp_path):
    boxes = [{"image_id": 1, "bbox": [9, 9, 5, 5], "iscrowd": crowd} for crowd in (0, 1)]
    images = [{"id": 1, "file_name": "1.png"}]
    (tmp_path / "a.json").write_text(json.dumps({"images": images, "annotations": boxes}))
    read: Any = read_detections(tmp_path / "a.json")
    assert len(read) == 1 and read.notes == ("1 boxes of crowds (iscrowd) are left out",)
    regions = "<ignored_region><box left='0' top='0' width='9' height='9'/></ignored_region></sequence>"
    (tmp_path / "a.xml").write_text(DETRAC.replace("</sequence>", regions))
    assert read_detections(tmp_path / "a.xml").notes == ("1 ignored regions of UA-DETRAC are left out",)


BDD = [
    {"videoName": "v", "frameIndex": 0, "labels": []},
    {
        "videoName": "v",
        "frameIndex": 1,
        "labels": [{"id": "00a", "category": "bus", "box2d": {"x1": 10, "y1": 20, "x2": 19, "y2": 39}}],
    },
]
DETRAC = """<?xml version="1.0"?><sequence name="s"><frame density="1" num="2"><target_list><target id="4">
<box left="10" top="20" width="10" height="20"/><attribute vehicle_type="bus" speed="1"/></target></target_list>
</frame></sequence>"""
FOREIGN = {
    "bdd.json": json.dumps(BDD),
    "detrac.xml": DETRAC,
    "video.viratdata.objects.txt": "4 10 1 10 20 10 20 3\n",
    "visdrone.txt": "2,4,10,20,10,20,1,9,0,1\n2,0,10,20,10,20,0,0,0,0\n",
    "dance.txt": "2,4,10,20,10,20,1,1,1\n",
}


@pytest.mark.parametrize("name", FOREIGN)
def test_tracks_of_data_sets_are_read(name, tmp_path):
    (tmp_path / name).write_text(FOREIGN[name])
    read: Any = read_detections(tmp_path / name)
    assert (read.frame.tolist(), read.box_px.tolist()) == ([2], [[10, 20, 10, 20]])
    assert read.identity[0] > 0
    classes = {"visdrone.txt": "bus", "detrac.xml": "bus", "bdd.json": "bus", "video.viratdata.objects.txt": "vehicle"}
    assert read.label is None or read.label[0] == classes[name]


def test_visdrone_has_its_own_names_for_persons_and_motorcycles_and_others_for_boxes_without_a_class(tmp_path):
    names = ("Person", "car", "motorcycle", "bike", "animal", "")
    table = concat([part for name in names for part in tracks((1, 2), (name, name))])
    notes = write_tracks(table, tmp_path / "a.txt", to="visdrone")
    rows = [line.split(",") for line in (tmp_path / "a.txt").read_text().splitlines()]
    categories = [row[7] for row in rows]
    assert categories == [number for number in ("1", "4", "10", "3", "11", "11") for _ in range(4)]
    assert "class Person is written as 1, pedestrian" in notes
    assert any("VisDrone has no class animal: written as 11, others" in note for note in notes)
    assert any("4 boxes without a class are written as 11, others" in note for note in notes)


def test_identities_from_0_and_words_are_numbered_from_1_with_a_note(tmp_path):
    for identities, wanted in (([0, 2], [1, 3]), (["b", "a"], [1, 2])):
        boxes = [{"image_id": 1, "bbox": [9, 9, 5, 5], "track_id": identity} for identity in identities]
        (tmp_path / "a.json").write_text(json.dumps(boxes))
        read: Any = read_detections(tmp_path / "a.json")
        assert read.identity.tolist() == wanted
        assert "identities" in read.notes[0]


def test_a_palette_png_has_its_places_in_the_palette_as_identities(tmp_path):
    image = pytest.importorskip("PIL.Image").new("P", (8, 6))
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    image.paste(2, (1, 1, 4, 3))
    image.save(tmp_path / "00000.png")
    read: Any = read_detections(tmp_path)
    assert (read.frame[0], read.identity[0], read.box_px[0].tolist()) == (1, 2, [1, 1, 3, 2])


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", "{", "broken"),
        ("a.json", "[1]", "box 1"),
        ("a.json", '[{"image_id": 1, "bbox": [1, 2, 3]}]', "box 1: bbox has 3"),
        ("a.json", '[{"image_id": 1, "bbox": [1, 2, 3, -4]}]', "box 1: height_px is '-4'"),
        ("a.json", '{"images": [], "categories": []}', "annotations"),
        ("a.xml", "<dataset/>", "<dataset>"),
        ("a.xml", '<annotations><track id="1"><box frame="0" xtl="1"/></track></annotations>', "'ytl' is missing"),
        ("a.parquet", "text", "as Parquet"),
    ],
)
def test_bad_files_give_one_line_with_the_box(name, content, said, tmp_path):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=name) as raised:
        read_detections(tmp_path / name)
    assert said in str(raised.value)


def test_places_come_back_from_parquet(tmp_path):
    pytest.importorskip("pyarrow")
    write_tracks(places(), tmp_path / "a.parquet")
    read: Any = read_positions(tmp_path / "a.parquet")
    np.testing.assert_allclose(read.lonlat_deg, places().lonlat_deg)
    assert (read.target.tolist(), read.east_north_m.tolist()) == ([5, 5], places().east_north_m.tolist())


def test_a_geopackage_says_that_its_points_are_longitudes_and_latitudes(tmp_path):
    write_tracks(places(), tmp_path / "a.gpkg")
    base = sqlite3.connect(tmp_path / "a.gpkg")
    assert base.execute("PRAGMA application_id").fetchone()[0] == int.from_bytes(b"GPKG", "big")
    assert base.execute("SELECT table_name, data_type, srs_id, min_x, max_y FROM gpkg_contents").fetchall() == [
        ("positions", "features", 4326, -110.95, 32.24)
    ]
    assert base.execute("SELECT column_name, geometry_type_name, srs_id FROM gpkg_geometry_columns").fetchall() == [
        ("geom", "POINT", 4326)
    ]
    assert base.execute("SELECT organization FROM gpkg_spatial_ref_sys WHERE srs_id = 4326").fetchone() == ("EPSG",)
    blob = base.execute("SELECT geom FROM positions").fetchone()[0]
    assert struct.unpack("<2sBBiBI2d", blob) == (b"GP", 0, 1, 4326, 1, 1, -110.95, 32.23)
    base.close()


def test_geoparquet_says_where_its_points_are(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_tracks(places(), tmp_path / "a.parquet")
    geo = json.loads(parquet.read_schema(tmp_path / "a.parquet").metadata[b"geo"])
    column = geo["columns"][geo["primary_column"]]
    assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", ["Point"])
    assert column["bbox"] == [-110.95, 32.23, -110.94, 32.24]
    blob = parquet.read_table(tmp_path / "a.parquet")[geo["primary_column"]][0].as_py()
    assert struct.unpack("<BI2d", blob) == (1, 1, -110.95, 32.23)


def test_places_and_boxes_do_not_mix(tmp_path):
    for given, name in ((places(), "a.json"), (tracks(), "a.gpkg"), ([], "a.json"), (tracks(), "a.doc")):
        with pytest.raises(InputError):
            write_tracks(given, tmp_path / name)
