"""How Sphinx makes the site; ./scripts/docs runs it. Nothing is fetched, neither to build nor to read it."""

import gc
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import ckc_pin
from scripts.site.domain import CkcDomain
from scripts.site.formulas import setup_formulas
from scripts.site.insert import inserted
from scripts.site.search_texts import setup_search

# Trees of documents are large and stay. Looking for garbage among them again and again took a fifth of the time.
gc.set_threshold(100_000, 50, 50)

project = "ckc_pin"
author = "the ckc_pin authors"
version = release = ckc_pin.__version__
copyright = author
language = "en"

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "sphinx_design", "sphinx_copybutton"]
exclude_patterns = ["_build", "paper_joss"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = True
default_role = "code"
nitpicky = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and units are in the docstrings
html_math_renderer = "drawn"

html_theme = "furo"
html_title = "ckc_pin"
html_static_path = ["_static"]
html_css_files = ["ckc.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "monokai"
copybutton_prompt_text = "$ "


BARS = re.compile(r"(`[^`]*`)|[|]")  # of |phi|, a norm: Sphinx takes them for substitutions


def setup(app):
    app.add_domain(CkcDomain)
    setup_formulas(app)
    setup_search(app)
    app.connect("source-read", insert)
    app.connect("autodoc-process-docstring", escape_bars)


def insert(app, docname, source):
    source[0] = inserted(source[0])


def escape_bars(app, what, name, obj, options, lines):
    lines[:] = [BARS.sub(lambda match: match[1] or r"\|", line) for line in lines]
