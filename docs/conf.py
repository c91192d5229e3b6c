"""Sphinx builds the site from these pages: `make docs` writes build/site/index.html, without a network.

Sphinx was chosen in November 2026: several maintainers keep it, and it makes the API reference from the docstrings by
itself. MkDocs 1 has no maintainer any more, Material for MkDocs ends its support, and Zensical is at 0.1.
"""

import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))
import generated_pages

import torchvision_dddas

project = html_title = "torchvision-dddas"
author = "the authors of torchvision-dddas"
version = release = torchvision_dddas.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
highlight_language = "none"
source_suffix = {".md": "markdown", ".py": "markdown"}  # each script of tutorials/ is a page
exclude_patterns = ["*.py"]
myst_heading_anchors = 4

html_theme = "furo"
html_copy_source = html_show_sourcelink = html_show_copyright = False
smartquotes = False  # options begin with two hyphens
html_static_path = ["_static"]
html_css_files = ["wide_tables.css"]

nitpicky = True
# The documentation of other libraries lies in the network; records that users do not make have no entry.
nitpick_ignore_regex = [("py:.*", ".*")]
default_role = "code"
autoclass_content = "both"  # arguments are described by the docstring of __init__
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88


def fill_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Replace a script by its page, and add to pages of the reference what comes from the code."""
    if docname.startswith("tutorials/") and Path(app.env.doc2path(docname)).suffix == ".py":
        source[0] = generated_pages.tutorial_page(source[0])
    elif docname == "reference/cli":
        source[0] += generated_pages.commands_page()
    elif docname == "reference/settings":
        source[0] += generated_pages.settings_page()


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", fill_page)
