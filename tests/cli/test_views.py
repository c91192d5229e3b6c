"""`dddas views`: tables of several cameras with identities that they share."""

import pytest

from tests.cli.conftest import bad, record, rows
from tests.two_views import boxes, camera, walk

HEADER = "frame,identity,x_px,y_px,width_px,height_px,note"


@pytest.fixture
def tables(tmp_path):
    paths = []
    for name, first, heading in (("a", 1, 0), ("b", 101, 60)):
        lines = [HEADER]
        for k, places in enumerate(walk(30)):
            seen = boxes(places, camera(heading), first, k + 1)
            cells = zip(seen.identity, seen.box_px.tolist(), strict=True)
            lines += [f"{k + 1},{number},{','.join(map(str, box))},x" for number, box in cells]
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_text("\n".join(lines) + "\n", encoding="utf-8")
    return paths


def test_views_writes_each_table_with_shared_identities(tables, dddas, tmp_path):
    assert dddas("views", *tables, "--out", tmp_path / "out").exit_code == 0
    views = [rows(tmp_path / "out" / f"view{k}.csv") for k in (1, 2)]
    shared = {(row["frame"], row["identity"]): row["own_identity"] for row in views[0]}
    keys = [(row["frame"], row["identity"]) for row in views[1]]
    pairs = [(shared[key], row["own_identity"]) for key, row in zip(keys, views[1], strict=True) if key in shared]
    assert len(pairs) > 200 and sum(int(a) + 100 == int(b) for a, b in pairs) > 0.97 * len(pairs)
    assert len(rows(tmp_path / "out" / "pairs.csv")) == len(pairs) and views[0][0]["note"] == "x"
    assert record(tmp_path / "out")["shared"] > 8 and rows(tmp_path / "out" / "maps.csv")


def test_an_empty_table_shares_nothing_and_a_note_says_so(tables, dddas, tmp_path):
    tables[1].write_text(HEADER + "\n", encoding="utf-8")
    said = dddas("views", *tables, "--out", tmp_path / "out").stdout
    assert (
        "no overlap was found in 30 of 30 moments; check that the clips begin at the same time" in said
        and "has no rows" in said
    )


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (None, ["--rate", 30], "1 rates and 2 tables"),
        ("frame,x_px,y_px,width_px,height_px\n1,2,3,4,5\n", [], "dddas track --detections"),
        ("frame,target,east_m,north_m\n1,2,3,4\n", [], "give one kind for all"),
    ],
)
def test_bad_input_is_one_line(tables, dddas, tmp_path, change, options, words):
    if change:
        tables[1].write_text(change, encoding="utf-8")
    assert words in bad(dddas("views", *tables, *options, "--out", tmp_path / "out"))
