"""How the documentation is built: ``make docs``; nothing here uses the network."""

import shutil
from pathlib import Path

import jax

import lusee_bayes

HERE = Path(__file__).parent

# signatures show Float[Array, "data"], not Float[jaxlib._jax.Array, "data"]
jax.Array.__name__ = "Array"

project = "lusee_bayes"
author = "the lusee_bayes developers"
version = release = lusee_bayes.__version__
html_title = f"lusee_bayes {version}"
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "cyclopts.sphinx_ext",
]
exclude_patterns = ["_build"]

myst_heading_anchors = 3
# Sphinx reads what is below this folder: the notebooks are copied to it, and links follow them.
# They are shown with the outputs that they hold: the tests run them
shutil.copytree(HERE.parent / "notebooks", HERE / "notebooks", dirs_exist_ok=True)
nb_execution_mode = "off"
highlight_language = "text"
# --option stays two hyphens
smartquotes = False

# the docstrings give types, shapes and units; signatures give names and defaults
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "exclude-members": "model_config"}
autodoc_preserve_defaults = True
autosummary_generate = False
numpydoc_show_class_members = False
numpydoc_attributes_as_param_list = True
maximum_signature_line_length = 88
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["lusee.css"]
html_theme_options = {
    # system fonts: nothing is fetched
    "light_css_variables": {"content-padding": "2em"},
}
pygments_style = "default"
pygments_dark_style = "github-dark"


# links between pages and notebooks as the repository has them, and on the site
MOVED = {
    "(../notebooks/": "(notebooks/",
    "(../docs/": "(../",
    "(../models)": "(../programs.md)",
}


def _follow_the_notebooks(app, name, source):
    for old, new in MOVED.items():
        source[0] = source[0].replace(old, new)


def setup(app):
    """Read pages through this."""
    app.connect("source-read", _follow_the_notebooks)
