"""The report of a study in a real browser: headless Chromium."""

import json

import pytest

from tests.browser import Browser, chromium
from tests.io.studied import HOSTILE, study
from torchvision_dddas.evaluation.report import report
from torchvision_dddas.evaluation.studies.summary import summary
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.io.report.page import SCRIPT
from torchvision_dddas.io.report.page import page as page_of
from torchvision_dddas.io.report.page_tables import Column, figure, sorted_table, words

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium on this machine: apt-get install chromium")

PHONE = (390, 844)
FIRST = "table.sorts"
_COLUMN = "Array.from(document.querySelector('table.sorts').tBodies[0].rows).map(r=>r.cells[{}].textContent)"
# WCAG 2: the relative luminance of a colour, and the contrast of a text with what is behind it.
_CONTRAST = """
(function(){
 function rgb(c){return c.match(/[\\d.]+/g).map(Number);}
 function light(c){var v=c.slice(0,3).map(function(x){x/=255;return x<=.03928?x/12.92:Math.pow((x+.055)/1.055,2.4);});
  return .2126*v[0]+.7152*v[1]+.0722*v[2];}
 function behind(e){for(;e;e=e.parentElement){var c=rgb(getComputedStyle(e).backgroundColor);
  if(c.length<4||c[3]>0)return c;}return[255,255,255];}
 var worst=[99,""];
 document.querySelectorAll("h1,h2,h3,p,td,th,li,small,figcaption,summary,a,span,button,svg text").forEach(function(e){
  if(!e.textContent.trim())return;
  var style=getComputedStyle(e),svg=e.namespaceURI.indexOf("svg")>0;
  var a=light(rgb(svg?style.fill:style.color)),b=light(behind(e));
  var ratio=(Math.max(a,b)+.05)/(Math.min(a,b)+.05);
  if(ratio<worst[0])worst=[ratio,e.tagName+" "+e.getAttribute("class")+" "+e.textContent.slice(0,30)];});
 return worst;})()
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    results = study(folder)
    path = folder / "report.html"
    path.write_text(report(finite(summary(results)), results), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as running:
        yield running


def column(browser, k):
    return browser.value(_COLUMN.format(k))


def state(browser, k):
    return browser.value(f"document.querySelectorAll('table.sorts thead th')[{k}].getAttribute('aria-sort')")


def test_a_click_on_a_heading_sorts_the_rows_and_another_one_turns_them_round(browser, page):
    browser.open(page)
    assert column(browser, 0) == ["bad", "good"]
    browser.click(f"{FIRST} thead th:nth-child(3) button")
    assert [text[:5] for text in column(browser, 2)] == ["0.333", "1.000"] and state(browser, 2) == "ascending"
    browser.click(f"{FIRST} thead th:nth-child(3) button")
    assert column(browser, 0) == ["good", "bad"] and state(browser, 2) == "descending"
    browser.click(f"{FIRST} thead th:nth-child(1) button")
    assert column(browser, 0) == ["bad", "good"]
    assert (state(browser, 0), state(browser, 2)) == ("ascending", None)


def test_what_belongs_to_all_clips_stays_below_them(browser, page):
    browser.open(page)
    below = f"Array.from(document.querySelector('{FIRST}').tFoot.rows).map(r=>r.cells[0].textContent)"
    browser.click(f"{FIRST} thead th:nth-child(3) button")
    assert browser.value(below) == ["pooled", "mean over clips"]


def test_a_table_is_sorted_by_keys_alone(browser, page):
    browser.open(page)
    reached = "document.activeElement.textContent"
    for _ in range(60):
        browser.press("Tab", 9)
        if browser.value(reached) == "F":
            break
    assert browser.value(reached) == "F"
    browser.press("Enter", 13)
    browser.press("Enter", 13)
    assert column(browser, 0) == ["good", "bad"]


def test_unknown_values_are_last_whichever_way_a_table_is_sorted(browser, page):
    browser.open(page)
    place = "table.sorts"
    script = f"""(function(){{var b=document.querySelector('{place}').tBodies[0];
      b.rows[0].cells[2].setAttribute('data-v','');return b.rows[0].cells[0].textContent;}})()"""
    unknown = browser.value(script)
    for _ in range(2):
        browser.click(f"{FIRST} thead th:nth-child(3) button")
        assert column(browser, 0)[-1] == unknown


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("size", [(1280, 900), PHONE])
def test_the_page_loads_without_an_error_and_asks_for_nothing_but_itself(browser, page, size, dark):
    browser.open(page, *size, dark)
    decoded = "Promise.all(Array.from(document.images).map(i=>(i.loading='eager',i.decode())))"
    shown = f"{decoded}.then(()=>document.images.length)"
    assert browser.value(shown) > 4
    wanted = [what for kind, what in browser.told if kind == "request" and not what.startswith("data:")]
    assert wanted == [page.resolve().as_uri()]
    assert [what for what in browser.told if what[0] in ("console", "thrown", "log")] == []


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_nothing_is_wider_than_the_window(browser, page, width):
    browser.open(page, width, 844)
    assert browser.value("document.documentElement.scrollWidth") <= width
    # Nor is anything cut: what is wider lies in a part that can be scrolled.
    wide = """Array.from(document.querySelectorAll('body *')).filter(function(e){
      var r=e.getBoundingClientRect();return r.right>innerWidth+1&&!e.closest('.wide')&&!e.closest('pre');})
      .map(e=>e.outerHTML.slice(0,80))"""
    assert browser.value(wide) == []


def test_words_are_large_enough_on_a_phone(browser, page):
    browser.open(page, *PHONE)
    small = """Math.min.apply(null,Array.from(document.querySelectorAll('.plots svg text')).map(function(t){
      var s=t.ownerSVGElement;return parseFloat(getComputedStyle(t).fontSize)*s.getBoundingClientRect().width
      /s.viewBox.baseVal.width;}))"""
    assert browser.value(small) >= 9


@pytest.mark.parametrize("dark", [False, True])
def test_by_night_the_page_is_dark_and_by_day_light_and_all_can_be_read(browser, page, dark):
    browser.open(page, dark=dark)
    paper = browser.value("getComputedStyle(document.body).backgroundColor")
    levels = [int(part) for part in paper.removeprefix("rgb(").removesuffix(")").split(",")]
    assert max(levels) < 50 if dark else min(levels) > 240
    ratio, where = browser.value(_CONTRAST)
    assert ratio >= 4.5, where


def test_every_picture_plot_and_table_says_what_it_is_to_who_hears_the_page(browser, page):
    browser.open(page)
    mute = """Array.from(document.querySelectorAll('img,svg:not([aria-hidden]),table,.wide')).filter(e=>
      !(e.getAttribute('alt')||e.getAttribute('aria-label')||'').trim()).map(e=>e.outerHTML.slice(0,80))"""
    assert browser.value(mute) == []
    scopes = "Array.from(document.querySelectorAll('th')).every(e=>['row','col'].includes(e.getAttribute('scope')))"
    assert browser.value(scopes)
    tree = browser.call("Accessibility.getFullAXTree")["nodes"]
    names = [node.get("name", {}).get("value", "") for node in tree if node.get("role", {}).get("value") == "image"]
    assert any(name.startswith("result of bad, frame 5: F 0.00") for name in names)


def test_a_name_that_looks_like_code_stays_a_name(browser, page):
    browser.open(page)
    assert browser.value("document.querySelectorAll('main b,td b,h1 b').length") == 0
    assert browser.value(f"document.body.textContent.includes({json.dumps(HOSTILE)})")
    assert browser.value("document.title") == "small <study>: study"


def test_rows_of_a_long_table_can_be_sought(browser, tmp_path):
    rows = [[words(f"clip {k}"), figure(k / 40)] for k in range(40)]
    text = page_of(
        "many", [f"<div>{sorted_table('many', [Column('clip', text=True), Column('F')], rows)}</div>"], script=SCRIPT
    )
    path = tmp_path / "many.html"
    path.write_text(text, encoding="utf-8")
    browser.open(path)
    browser.click("input[type=search]")
    browser.call("Input.insertText", text="Clip 3")
    shown = "Array.from(document.querySelectorAll('tbody tr')).filter(r=>!r.hidden).map(r=>r.cells[0].textContent)"
    assert browser.value(shown) == ["clip 3", *(f"clip 3{k}" for k in range(10))]
    browser.click("thead th:nth-child(1) button")
    browser.click("thead th:nth-child(1) button")
    assert browser.value(shown)[0] == "clip 39"  # as numbers go, not letters


def test_a_tall_table_keeps_its_headings_and_what_belongs_to_all_in_sight(browser, tmp_path):
    rows = [[words(f"clip {k}"), figure(k / 400)] for k in range(400)]
    columns = [Column("clip", text=True), Column("F")]
    table = sorted_table("many", columns, rows, [[words("pooled"), figure(0.5)]])
    path = tmp_path / "tall.html"
    path.write_text(page_of("tall", [f"<div>{table}</div>"]), encoding="utf-8")
    browser.open(path)
    assert browser.value("document.documentElement.scrollHeight") <= 1200
    browser.value("document.querySelector('.wide').scrollTop=5000")
    inside = """(function(){var w=document.querySelector('.wide').getBoundingClientRect();
      return ['thead th','tfoot th'].map(function(s){var r=document.querySelector(s).getBoundingClientRect();
      return r.top>=w.top-1&&r.bottom<=w.bottom+1;});})()"""
    assert browser.value(inside) == [True, True]
