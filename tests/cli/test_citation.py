"""`dddas citation` prints the entries of CITATION.cff."""

import re
from pathlib import Path

from torchvision_dddas.cli.citation import bibtex_entries


def test_the_software_and_each_reference_is_an_entry_of_its_own(dddas) -> None:
    done = dddas("citation")
    assert done.exit_code == 0
    cff = (Path(__file__).parents[2] / "CITATION.cff").read_text()
    titles = re.findall(r"^ *title: (.+)$", cff, re.M)
    assert re.findall(r"^  title = \{(.+)\},$", done.stdout, re.M) == titles
    assert re.findall(r"^@(\w+)\{", done.stdout, re.M) == ["software", "article", "phdthesis"]
    assert done.stdout.count("{") == done.stdout.count("}")


def test_an_entry_has_all_authors_and_its_own_fields() -> None:
    cff = "type: software\ntitle: a\nauthors:\n  - name: The makers\nreferences:\n  - type: article\n    title: b & c\n"
    cff += "    authors:\n      - family-names: Doe\n        given-names: J.\n      - family-names: Roe\n"
    cff += "        given-names: R.\n    year: 2018\n"
    software, article = bibtex_entries(cff)
    assert "author = {{The makers}}" in software
    assert article == "@article{doe2018,\n  author = {Doe, J. and Roe, R.},\n  title = {b \\& c},\n  year = {2018},\n}"
