"""The pages of the report kit in headless Chromium: they fit, can be read, and sort."""

import numpy as np
import pytest
from markupsafe import Markup

from tests.browser import evaluate, needs_browser
from tests.lab.evaluation.report.studied import HOSTILE, study
from torchvision_dddas.io.output.run_record import finite
from torchvision_dddas.io.report import ReportColumn, environment, number_cell, table, text_cell
from torchvision_dddas.io.report.charts import Axis, Line, chart
from torchvision_dddas.lab.evaluation.report import study_report
from torchvision_dddas.lab.evaluation.studies.summary import summarize

pytestmark = [pytest.mark.browser, pytest.mark.slow, needs_browser]

# WCAG 2: the contrast of each text with the background behind it; the worst is returned.
_CONTRAST = r"""
 function rgb(c){return c.match(/[\d.]+/g).map(Number);}
 function light(c){var v=c.slice(0,3).map(function(x){x/=255;return x<=.03928?x/12.92:Math.pow((x+.055)/1.055,2.4);});
  return .2126*v[0]+.7152*v[1]+.0722*v[2];}
 function behind(e){for(;e;e=e.parentElement){var c=rgb(view.getComputedStyle(e).backgroundColor);
  if(c.length<4||c[3]>0)return c;}return[255,255,255];}
 var worst=[99,""];
 page.querySelectorAll("h1,h2,h3,p,td,th,li,small,figcaption,summary,a,span,button,svg text").forEach(function(e){
  if(!e.textContent.trim())return;
  var style=view.getComputedStyle(e),svg=e.namespaceURI.indexOf("svg")>0;
  var a=light(rgb(svg?style.fill:style.color)),b=light(behind(e));
  var ratio=(Math.max(a,b)+.05)/(Math.min(a,b)+.05);
  if(ratio<worst[0])worst=[ratio,e.tagName+" "+e.getAttribute("class")+" "+e.textContent.slice(0,30)];});
 return {worst:worst,paper:rgb(view.getComputedStyle(page.body).backgroundColor)};
"""
_LAYOUT = """
 var wide=Array.from(page.querySelectorAll("body *")).filter(function(e){return e.getBoundingClientRect().right>
  view.innerWidth+1&&!e.closest(".wide")&&!e.closest("pre");}).map(function(e){return e.outerHTML.slice(0,80);});
 var letters=Array.from(page.querySelectorAll(".plots svg text")).map(function(t){var s=t.ownerSVGElement;
  return parseFloat(view.getComputedStyle(t).fontSize)*s.getBoundingClientRect().width/s.viewBox.baseVal.width;});
 var mute=Array.from(page.querySelectorAll("img,svg:not([aria-hidden]),table,.wide")).filter(function(e){
  return !(e.getAttribute("alt")||e.getAttribute("aria-label")||"").trim();}).length;
 return {width:page.documentElement.scrollWidth,wide:wide,smallest:Math.min.apply(null,letters),mute:mute,
  pictures:page.images.length};
"""
_ROWS = "function rows(k){return Array.from(page.querySelector('tbody').rows).filter(function(r){return !r.hidden;})"
_ROWS += ".map(function(r){return r.cells[k].textContent;});}"
_PRESS = "function press(k){page.querySelectorAll('thead button')[k].click();}"


@pytest.fixture(scope="module")
def study_page(tmp_path_factory):
    results = study(tmp_path_factory.mktemp("study"))
    return study_report(finite(summarize(results)), results)


def page_of(*parts):
    template = '{% extends "base.html" %}{% block body %}{{ parts | join }}{% endblock %}'
    return environment().from_string(template).render(title="many", parts=[Markup(part) for part in parts])


def many_rows(count):
    rows = [[text_cell(f"clip {k}"), number_cell(k / count if k else None)] for k in range(count)]
    parts = table(
        "many", [ReportColumn("clip", text=True), ReportColumn("F")], rows, [[text_cell("pooled"), number_cell(0.5)]]
    )
    svg = chart("t", Axis("x"), Axis("y"), [Line("l", np.arange(9.0), np.arange(9.0))])
    return page_of(f"<div>{parts}</div>", svg)


def test_a_table_sorts_by_number_and_by_word_in_both_directions_with_unknown_values_last(tmp_path):
    script = f"""{_ROWS}{_PRESS} var found=[];
      [1,1,0,0].forEach(function(k){{press(k);found.push(rows(0));}});
      return {{found:found,foot:page.querySelector('tfoot').textContent.trim(),
        sort:page.querySelectorAll('thead th')[0].getAttribute('aria-sort')}};"""
    got = evaluate(many_rows(12), script, tmp_path)
    names = [f"clip {k}" for k in range(12)]
    assert got["found"][0] == [*names[1:], names[0]] and got["found"][1] == [*names[:0:-1], names[0]]
    assert got["found"][2] == names and got["found"][3] == names[::-1] and got["sort"] == "descending"
    assert got["foot"].startswith("pooled")


def test_rows_of_a_long_table_can_be_searched_and_its_headings_stay_in_sight(tmp_path):
    script = f"""{_ROWS} var field=page.querySelector("input[type=search]"),w=page.querySelector(".wide");
      var height=page.documentElement.scrollHeight; w.scrollTop=5000; var box=w.getBoundingClientRect();
      var inside=["thead th","tfoot th"].map(function(s){{var r=page.querySelector(s).getBoundingClientRect();
        return r.top>=box.top-1&&r.bottom<=box.bottom+1;}});
      field.value="CLIP 39"; field.dispatchEvent(new view.Event("input"));
      return {{rows:rows(0),inside:inside,height:height}};"""
    got = evaluate(many_rows(400), script, tmp_path)
    assert got["rows"] == ["clip 39", *(f"clip 39{k}" for k in range(10))]
    assert got["inside"] == [True, True] and got["height"] <= 2200


@pytest.mark.parametrize("width", [320, 390, 1280])
def test_the_page_of_a_study_fits_every_window_and_says_what_it_shows(study_page, tmp_path, width):
    got = evaluate(study_page, _LAYOUT, tmp_path, width)
    assert got["width"] <= width and got["wide"] == [] and got["mute"] == 0 and got["pictures"] > 4
    assert got["smallest"] >= (9 if width >= 390 else 7)


@pytest.mark.parametrize("dark", [False, True])
def test_the_page_is_light_or_dark_as_the_user_prefers_and_all_text_can_be_read(study_page, tmp_path, dark):
    got = evaluate(study_page, _CONTRAST, tmp_path, dark=dark)
    assert max(got["paper"]) < 50 if dark else min(got["paper"]) > 240
    ratio, where = got["worst"]
    assert ratio >= 4.5, where


def test_a_name_that_looks_like_code_stays_a_name(study_page, tmp_path):
    script = "return [page.querySelectorAll('td b,h1 b').length, page.body.textContent, page.title];"
    bold, text, title = evaluate(study_page, script, tmp_path)
    assert bold == 0 and HOSTILE in text and title == "small <study>: study"
