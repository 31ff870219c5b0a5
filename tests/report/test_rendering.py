"""What every template may use: numbers, tables, pictures; what is missing is an error."""

import numpy as np
import pytest
from jinja2 import UndefinedError

from lusee_bayes.core.errors import InputError
from lusee_bayes.report.rendering import ENVIRONMENT, asset, formatted, p_value, picture, render


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [(1.234, ".2f", "1.23"), (0.5, ".1%", "50.0%"), (None, ".2f", "-"), (np.nan, "", "-")],
)
def test_numbers_are_formatted_and_what_is_missing_is_said(value, form, text):
    assert formatted(value, form, "-") == text
    assert formatted("as it is", form, "-") == "as it is"


def test_probabilities_of_a_column_have_no_equals_sign():
    assert p_value(0.62) == "0.62"
    assert p_value(0.0).startswith("< ")
    assert p_value(np.nan, "no others") == "no others"


def test_what_users_write_cannot_become_tags_and_bad_rows_stand_out():
    text = """{% from "macros.html" import cells, table with context %}
    {%- call(row) table(("a", "b"), rows, [false, true]) %}{{ cells(*row) }}{% endcall %}"""
    rows = [("<b>", 1), ("&", 2)]
    page = ENVIRONMENT.from_string(text).render(rows=rows)
    assert "<tr><td>&lt;b&gt;</td><td>1</td></tr>" in page
    assert "<tr class=bad><td>&amp;</td><td>2</td></tr>" in page


def test_a_page_without_what_it_shows_is_an_error(tmp_path):
    with pytest.raises(UndefinedError, match="caveat"):
        render("comparison.html", tmp_path, runs=[], rows=[])
    with pytest.raises(InputError, match=r"no figures/maps\.png"):
        picture(tmp_path, "maps")


def test_scripts_and_styles_are_as_in_their_files():
    assert "const skyView" in asset("sky_view.js") and "&lt;" not in asset("sky_view.js")
    assert str(asset("report.css")).startswith(":root {")


def test_every_template_can_be_read():
    names = [name for name in ENVIRONMENT.list_templates() if name.endswith(".html")]
    assert {"map.html", "sample.html", "priors.html", "comparison.html"} <= set(names)
    for name in names:
        ENVIRONMENT.get_template(name)
