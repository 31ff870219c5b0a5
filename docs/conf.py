"""How the documentation is built: ``make docs``; nothing here uses the network."""

import jax

import lusee_bayes

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
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "cyclopts.sphinx_ext",
]
exclude_patterns = ["_build"]

myst_heading_anchors = 3
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
