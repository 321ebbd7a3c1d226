"""Builds the site: `bash .ci/docs`. The network is not needed."""

import os
import sys
from pathlib import Path

import swarmjax

sys.path.insert(0, str(Path(__file__).resolve().parent / "_ext"))

project = "swarmjax"
author = "The swarmjax developers"
project_copyright = author
version = release = swarmjax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "site_cells",
    "site_errors",
    "site_keys",
    "site_links",
    "site_signatures",
]
exclude_patterns = ["_build", "_ext", "**/.ipynb_checkpoints", "**/runs"]
default_role = "code"
nitpicky = True
# What the site has no page of: other packages, and what users have no need to call.
nitpick_ignore_regex = [
    ("py:.*", r"(?!swarmjax\.).*"),
    ("py:class", r"swarmjax\.(training|task\.(env|stage|world)|adapters\.\w+|sim|run)\..*"),
]

# Notebooks: each runs in a folder of its own, and one that fails fails the build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_timeout = 900
nb_execution_show_tb = False
nb_merge_streams = True
nb_output_stderr = "show"
os.environ["TTY_COMPATIBLE"] = "0"  # a notebook asks for colours, and progress would be drawn

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["stable_baselines3", "torch"]  # extras of 5 GB
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "swarmjax"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
html_copy_source = False
html_show_sphinx = False
html_last_updated_fmt = None
linkcheck_timeout = 15
