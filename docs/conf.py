"""Sphinx configuration. Build: ``sphinx-build -W docs docs/_build``."""

import os
import sys
from importlib.metadata import version as _version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "gfmhil"
author = "gfmhil developers"
project_copyright = "gfmhil developers"
version = release = _version("gfmhil")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "_ext.generated",
    "_ext.thumbnails",
]
exclude_patterns = ["_build", "_ext", "_figures", "examples", "tables"]

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# The notebook and the gallery run while the pages are built, and an error in them ends the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 900  # s a cell; a machine may be slow
os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # of the kernels

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_use_ivar = True

# MathJax 3.2.2 (Apache-2.0) is part of the repository: the pages need no network. It is the full
# build, because the small one fetches TeX extensions when a formula first uses them.
mathjax_path = "mathjax/tex-svg-full.js"

html_theme = "furo"
html_title = f"gfmhil {release}"
html_static_path = ["_static"]
html_css_files = ["gfmhil.css"]
