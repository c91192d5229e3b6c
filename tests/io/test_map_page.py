"""The interactive map of a report: its data, and the page in headless Chromium."""

import json
from itertools import pairwise

import numpy as np
import pytest

from tests.browser import evaluate, needs_browser
from tests.io.ground import NAMES, ORIGIN, positions, tracks
from torchvision_dddas import geometry
from torchvision_dddas.io.maps import map_page
from torchvision_dddas.io.maps.map_page import map_data
from torchvision_dddas.io.maps.map_picture import CameraPath, Signs
from torchvision_dddas.io.output.run_record import RunRecord, finite
from torchvision_dddas.io.output.run_report import RunReport
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.types import Ortho

HOSTILE = "</script><img src=x onerror=view.trouble.push(1)><b>field</b>"
NONE = tracks([])


def degrees(metres):
    return geometry.lonlat(metres, ORIGIN)


def walk(frames=range(1, 101), lost=()):
    """A target that goes a metre east each frame, and one that stands, each with an ellipse of 4.9 m by 2.4 m."""
    known = ((4, 0), (0, 1))
    return tracks([positions(k, [[k - 1, 0], [0, 40]], known) for k in frames if k not in lost])


def data_of(targets, photo=None, signs=None):
    marks = tracks([positions(k, [[50, 50 - k]], target=[0]) for k in (1, 50, 100)])
    views = [(k, (k - 1) / 10, np.array([[k, -50], [k + 50, -50], [k + 50, 50.0]])) for k in range(1, 101, 10)]
    camera = CameraPath(np.array([[0, 5], [90, 5.0]]), views[-1][2], views)
    way = tracks([positions(k, [[k, 5]], np.full((2, 2), np.nan), target=[0]) for k in (1, 90)])
    return map_data(targets, marks, (HOSTILE, *NAMES), camera, way, photo, signs or Signs(), degrees)


def page_of(folder, data):
    text = RunReport("t", RunRecord(folder, {}), True, Timeline(), [], map=data, map_file="map.png").html()
    watch = """<head><script>window.trouble=[];["error","unhandledrejection"].forEach(function(kind){
      addEventListener(kind,function(e){if(e.message||e.reason)trouble.push(String(e.message||e.reason));});});
      console.error=console.warn=function(m){trouble.push(String(m));};
      window.requestAnimationFrame=function(f){return setTimeout(f,16);};</script>"""  # no frames in virtual time
    return text.replace("<head>", watch, 1)


def test_tracks_are_cut_at_gaps_and_everything_lies_in_the_whole_box():
    data = data_of(walk(lost=range(30, 60)))
    assert data is not None and json.dumps(finite(data), allow_nan=False)
    moving = next(one for one in data["movers"] if one["name"] == "1")
    assert [len(part) for part in moving["parts"]] == [29, 41]
    assert moving["parts"][0][1] == [0.1, 1.0, 0.0, pytest.approx(4.9, abs=0.01), pytest.approx(2.45, abs=0.01), 90, 2]
    west, south, east, north = data["whole"]
    assert west < -2.5 and east > 150 and south < -50 and north > 50 and data["span"] == [0, 9.9] and data["note"] == ""
    assert np.allclose(data["degrees"][0], degrees(np.array([data["box"][:2]]))[0])
    assert map_data(NONE, NONE, (), CameraPath(), NONE, None, Signs(), None) is None


def test_a_run_without_a_place_of_a_target_has_no_map_and_fused_targets_are_a_layer():
    assert data_of(NONE) is None
    marks, camera = tracks([positions(1, [[5, 5]], target=[0])]), CameraPath()
    data = map_data(NONE, marks, NAMES, camera, NONE, None, Signs(), None, walk())
    assert data is not None
    assert [one["name"] for one in data["movers"] if one["kind"] == "fused"] == ["fused 1", "fused 2"]


def test_long_tracks_are_thinned_evenly_with_a_note_and_keep_their_ends(monkeypatch):
    monkeypatch.setattr(map_page, "MOST_PLACES", 40)
    data = data_of(walk())
    rows = [[row for part in one["parts"] for row in part] for one in data["movers"] if one["kind"] == "target"]
    assert 36 <= sum(map(len, rows)) <= 44 and "evenly spread" in data["note"]
    for kept in rows:
        assert kept[0][-1] == 1 and kept[-1][-1] == 100
        assert max(b[-1] - a[-1] for a, b in pairwise(kept)) <= 6


def test_a_photo_is_cropped_to_the_map_and_one_that_lies_elsewhere_is_left_out():
    image = np.full((2000, 2000, 3), 90, np.uint8)
    wide = Ortho(image, np.array([[1, 0, -1000.0], [0, -1, 1000.0]]))
    data = data_of(walk(), wide)
    assert np.allclose(data["photo"]["box"], data["whole"], atol=3) and len(data["photo"]["url"]) < 20_000
    assert data_of(walk(), Ortho(image, np.array([[1, 0, 9000.0], [0, -1, 1000.0]])))["photo"] is None


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    signs = Signs()
    signs.zones.append((HOSTILE, [np.array([[10, -30], [40, -30], [40, -10.0]])], False))
    signs.add_event("enter", np.array([20.0, -20]))
    photo = Ortho(np.full((200, 200, 3), 90, np.uint8), np.array([[0.5, 0, -20.0], [0, -0.5, 60.0]]))
    return page_of(tmp_path_factory.mktemp("page"), data_of(walk(), photo, signs))


def in_browser(test):
    return pytest.mark.browser(pytest.mark.slow(needs_browser(test)))


_TOOLS = """
 var box=page.getElementById("map").getBoundingClientRect(),get=function(id){return page.getElementById(id);};
 function mouse(kind,x,y){(page.elementFromPoint(x,y)||page.body).dispatchEvent(new view.MouseEvent(kind,{clientX:x,
  clientY:y,bubbles:true,view:view,buttons:1,detail:1}));}
 function wait(ms){return new Promise(function(done){view.setTimeout(done,ms);});}
 function place(){mouse("mousemove",box.left+box.width/2,box.top+box.height/2);
  return get("place").textContent.match(/-?[0-9.]+/g).map(Number);}
 function ticks(){return Array.from(page.querySelectorAll("#map .tick")).map(function(t){return t.textContent;});}
 function tag(name){return Array.from(page.querySelectorAll("#map .tag")).find(function(t){
  return t.textContent===name;}).getBoundingClientRect();}
 function slide(k){get("time").value=k;get("time").dispatchEvent(new view.Event("input"));}
"""


@in_browser
def test_the_map_zooms_and_pans(page, tmp_path):
    script = """var before=place(),first=ticks();
     page.querySelector(".leaflet-control-zoom-in").click();
     return wait(600).then(function(){var finer=ticks(),x=box.left+300,y=box.top+120;
      mouse("mousedown",x,y);
      [20,60,100].forEach(function(k){mouse("mousemove",x+k,y);});mouse("mouseup",x+100,y);
      return wait(600).then(function(){return {before:before,after:place(),first:first,finer:finer};});});"""
    got = evaluate(page, _TOOLS + script, tmp_path)
    assert got["after"][0] < got["before"][0] - 5 and abs(got["after"][1] - got["before"][1]) < 1
    east, north, latitude, longitude = got["after"]
    assert np.allclose(degrees(np.array([[east, north]])), [[longitude, latitude]], atol=2e-6)
    assert got["first"] != got["finer"]


@in_browser
def test_names_of_zones_within_each_other_do_not_overlap(tmp_path):
    signs, square = Signs(), np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    signs.zones += [(name, [20 + size * square], False) for name, size in (("a", 5), ("b", 8), ("c", 12))]
    page = page_of(tmp_path, data_of(walk(), signs=signs))
    got = evaluate(
        page, _TOOLS + "return ['a','b','c'].map(function(n){var r=tag(n);return [r.top,r.bottom];});", tmp_path
    )
    for (_, lower), (upper, _) in pairwise(sorted(got)):
        assert upper >= lower - 1


@in_browser
def test_the_slider_and_play_move_the_targets_and_a_click_opens_the_ellipse(page, tmp_path):
    script = """slide(20);var a=tag("1");slide(60);var b=tag("1"),still=tag("2");slide(20);
     var when=get("now").textContent,words=[];
     mouse("mousedown",a.left-6,a.top+a.height/2);mouse("mouseup",a.left-6,a.top+a.height/2);
     mouse("click",a.left-6,a.top+a.height/2);
     return wait(500).then(function(){words.push(page.querySelector(".leaflet-popup-content").textContent);
      get("play").click();return wait(1000);}).then(function(){get("play").click();
      return {moved:b.left-a.left,still:still.left,when:when,words:words[0],value:+get("time").value};});"""
    got = evaluate(page, _TOOLS + script, tmp_path)
    assert got["moved"] > 100 and got["when"].startswith("2.0 s, ") and got["when"].endswith("UTC")
    assert "target 1\n2.0 s" in got["words"] and "20.0 m east" in got["words"]
    assert "semi-axes 4.90 m and 2.45 m" in got["words"] and 24 < got["value"] < 40


@in_browser
@pytest.mark.parametrize("width", [375, 1280])
def test_the_page_fits_asks_for_nothing_outside_and_takes_names_for_words(page, tmp_path, width):
    script = """var boxes=Array.from(page.querySelectorAll("#layers input"));
     function tags(){return page.querySelectorAll("#map .tag").length;} var shown=tags();
     boxes.forEach(function(b){b.click();});
     return wait(500).then(function(){var left=tags();
      boxes.forEach(function(b){b.click();});return {left:left,shown:shown,trouble:view.trouble,
      width:page.documentElement.scrollWidth,
      asked:view.performance.getEntriesByType("resource").map(function(e){return e.name;}),
      bold:page.querySelectorAll("b,img[src=x]").length,height:box.height,words:page.getElementById("map").textContent};});"""
    got = evaluate(page, _TOOLS + script, tmp_path, width)
    assert got["trouble"] == [] and got["width"] <= width and got["bold"] == 0
    assert all(name.startswith("data:") or name.endswith("/map.png") for name in got["asked"])
    assert got["words"].count(HOSTILE) == 2 and got["shown"] >= 5 and got["left"] == 0 and got["height"] >= 340
