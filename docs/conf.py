"""How the documentation is built: ``make docs``; nothing here uses the network."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extension"))

import jax

# in signatures: Float[Array, "data"], not Float[jaxlib._jax.Array, "data"]
jax.Array.__name__ = "Array"

import lusee_bayes  # noqa: E402

project = "lusee_bayes"
author = "the lusee_bayes developers"
version = release = lusee_bayes.__version__
html_title = f"lusee_bayes {version}"
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False

extensions = ["myst_parser", "sphinx.ext.autodoc", "lusee_docs"]
exclude_patterns = ["_build"]

myst_heading_anchors = 3
highlight_language = "text"

# the public names, in the order of the source, with shapes as they are annotated
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
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
