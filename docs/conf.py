"""Sphinx: how the documentation is built. ``make docs``; why so: decisions/0017-site.md."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

gc.set_threshold(50_000, 20, 20)  # a tenth of the time: most of what pages are made of stays

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

from modeharvest.util import version as own_version  # noqa: E402

project = "modeharvest"
author = "the authors of modeharvest"
release = version = own_version()
copyright = "2026, the authors of modeharvest. MIT licence"
language = "en"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "mathml",
    "docstrings",
    "long_cells",
    "api_pages",
    "cli_pages",
    "key_pages",
    "schema_pages",
]
root_doc = "index"
exclude_patterns = ["_build", "_ext"]
nitpicky = True
# Names of other libraries, and what a docstring calls a type: their pages are not at hand offline.
nitpick_ignore_regex = [
    ("py:.*", r"(?!modeharvest\.).*"),
    ("py:.*", r"modeharvest\.([\w.]+\.)?(_\w+|[A-Z]|CaseType)"),  # private; variables of types
]
suppress_warnings = ["ref.python"]  # a short name in a type that several classes have

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

viewcode_follow_imported_members = False
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
_arrays = ("FloatArray", "FloatImage", "ComplexArray", "IntArray", "BoolArray")
autodoc_type_aliases = {name: f"modeharvest.util.arrays.{name}" for name in _arrays}
autodoc_type_aliases["ArrayLike"] = "ArrayLike"  # else written out, in three lines
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
add_module_names = False
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False

sphinx_gallery_conf = {
    "examples_dirs": "../examples/gallery",
    "gallery_dirs": "generated/gallery",
    "abort_on_example_error": True,
    "only_warn_on_example_error": False,
    "download_all_examples": False,
    "show_signature": False,
    "capture_repr": (),
    "show_memory": False,
    "min_reported_time": 1e9,
    "within_subsection_order": "FileNameSortKey",
    "matplotlib_animations": False,
    "reset_modules": ("matplotlib",),
    "thumbnail_size": (320, 224),
    "default_thumb_file": str(HERE / "images" / "report.jpg"),
    "write_computation_times": False,
}

html_theme = "furo"
html_title = f"modeharvest {release}"
html_static_path = ["_static"]
html_css_files = ["modeharvest.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "monokai"
