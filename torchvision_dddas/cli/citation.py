"""`dddas citation`: print how to cite the package and the work that it implements, as BibTeX."""

import re
from collections.abc import Iterator
from pathlib import Path

from torchvision_dddas.cli.options import print_lines, report_errors
from torchvision_dddas.errors import InputError

_KINDS = {"software": "software", "article": "article", "thesis": "phdthesis"}
_FIELDS = {name: name for name in ("title", "journal", "version", "year", "doi", "url")}
_FIELDS |= {"license": "note", "repository-code": "url"}


@report_errors
def citation() -> None:
    """Print how to cite this software and the work that it implements, as BibTeX."""
    package = Path(__file__).resolve().parents[1]
    # A wheel has the file beside the code. A checkout has the file in its top folder.
    for place in (package / "CITATION.cff", package.parent / "CITATION.cff"):
        if place.is_file():
            print_lines(list(bibtex_entries(place.read_text(encoding="utf-8"))))
            return
    raise InputError(f"{package / 'CITATION.cff'} is missing; install torchvision-dddas again")


def bibtex_entries(cff: str) -> Iterator[str]:
    """Yield the BibTeX entry of the software, then the entry of each reference in a CITATION.cff.

    Only the layout of our own file is read, so that no YAML library is needed: a key and its value on one line.
    """
    software, *references = re.split(r"^ *- (?=type:)", cff, flags=re.M)
    yield _entry(software)
    yield from map(_entry, references)


def _entry(block: str) -> str:
    lines = re.findall(r"^[ -]*([\w-]+): *['\"]?(.+?)['\"]?$", block, re.M)
    given = dict(lines)
    family = [value for key, value in lines if key == "family-names"]
    first = [value for key, value in lines if key == "given-names"]
    authors = [f"{last}, {before}" for last, before in zip(family, first, strict=True)] or [f"{{{given['name']}}}"]
    fields = {"author": " and ".join(authors)} | {_FIELDS[key]: value for key, value in lines if key in _FIELDS}
    if given["type"] == "thesis":
        fields["school"] = given["name"]
    key = family[0].lower() + given.get("year", "-" + given["type"]) if family else given["title"]
    values = "".join(f"  {name} = {{{value.replace('&', chr(92) + '&')}}},\n" for name, value in fields.items())
    return f"@{_KINDS[given['type']]}{{{key},\n{values}}}"
