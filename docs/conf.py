"""Sphinx configuration. Build: ``sphinx-build -W docs docs/_build``."""

import sys
from importlib.metadata import version as _version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "gfmhil"
author = "gfmhil developers"
project_copyright = "gfmhil developers"
version = release = _version("gfmhil")

extensions = ["myst_parser", "sphinx.ext.mathjax", "_ext.generated"]
exclude_patterns = ["_build", "_ext", "_figures", "examples", "tables"]

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# MathJax 3.2.2 (Apache-2.0) is part of the repository: the pages need no network. It is the full
# build, because the small one fetches TeX extensions when a formula first uses them.
mathjax_path = "mathjax/tex-svg-full.js"

html_theme = "furo"
html_title = f"gfmhil {release}"
html_static_path = ["_static"]
html_css_files = ["gfmhil.css"]
