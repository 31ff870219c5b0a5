"""What figures and pages are drawn with: Mollweide views, the beam of maps, warnings, ticks."""

import healpy
import numpy as np
import pytest
from assertions import refuse
from jinja2 import UndefinedError
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.projections.geo import MollweideAxes

from lusee_bayes.core import harmonics
from lusee_bayes.judge.convergence import warnings_of
from lusee_bayes.report.figures import drawing
from lusee_bayes.report.rendering import ENVIRONMENT, formatted, p_value, picture, render


def test_points_lie_where_matplotlib_puts_them():
    transform = MollweideAxes.MollweideTransform(1)
    x, y = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 4000))
    inside = np.hypot(x, y) < 0.999
    lon, lat = drawing.unprojected(x[inside], y[inside])
    # matplotlib's longitude grows to the right; its ellipse is sqrt(2) times (2, 1)
    theirs = transform.transform(np.radians(np.stack([-lon, lat], axis=1)))
    # its own iteration for the latitude stops at 1e-3 radians
    expected = np.sqrt(2.0) * np.stack([2.0 * x[inside], y[inside]], axis=1)
    np.testing.assert_allclose(theirs, expected, atol=3e-3)


def test_a_map_of_longitude_and_latitude_comes_out_as_it_went_in():
    nside = 64
    x, y, z = map(drawing.view, healpy.pix2vec(nside, np.arange(12 * nside**2)))
    middle = quarter = drawing.WIDTH // 4
    # the centre of the view is l = 0; halfway to the left l = 90 degrees; the top is the pole
    np.testing.assert_allclose(x[middle, drawing.WIDTH // 2], 1.0, atol=2e-2)
    np.testing.assert_allclose(y[middle, quarter], 1.0, atol=2e-2)
    np.testing.assert_allclose(z[-1, drawing.WIDTH // 2], 1.0, atol=2e-2)
    # a unit vector stays one, up to what bilinear interpolation loses
    np.testing.assert_allclose(x**2 + y**2 + z**2, 1.0, atol=2e-3)


@pytest.mark.parametrize("lmax", [1, 8, 47])
def test_the_taper_is_healpys_gaussian_beam(lmax):
    beam = healpy.gauss_beam(np.radians(harmonics.taper_fwhm_deg(lmax)), lmax)
    np.testing.assert_allclose(harmonics.taper(lmax, lmax // 2), beam[: lmax // 2 + 1], rtol=1e-12)
    np.testing.assert_allclose(harmonics.taper(lmax), beam, rtol=1e-12)
    assert harmonics.taper(lmax)[-1] == pytest.approx(harmonics.LEFT_AT_LMAX)


def test_a_bar_of_small_numbers_states_them():
    figure = Figure()
    image = figure.subplots().imshow([[0.04, 0.3]], norm=LogNorm(0.03, 0.44))
    labels = drawing.colour_bar(figure, image, figure.axes[0]).ax.get_yticklabels()
    assert {0.03, 0.05, 0.1, 0.2} <= {float(one.get_text()) for one in labels}


def test_a_sky_of_one_mode_is_shown():
    np.testing.assert_allclose(harmonics.taper(0), [1.0])
    np.testing.assert_allclose(drawing.shown(np.array([2.0]), 4), 2.0 / np.sqrt(4.0 * np.pi))


@pytest.mark.parametrize("lmax", [12, 47])
def test_an_edge_has_no_rings(lmax):
    # A belt of 10 on a sky of 1, |b| < 5 degrees. Cut at lmax it swings to both sides; seen
    # through a positive beam it stays between 1 and 10. A tenth of the highest ell is left, so
    # that a tenth of the swing is allowed.
    pixels = np.ones(12 * 64**2)
    pixels[np.abs(healpy.pix2ang(64, np.arange(pixels.size), lonlat=True)[1]) < 5.0] = 10.0
    modes = harmonics.map_to_modes(pixels, lmax)
    swing = 1.0 - harmonics.modes_to_map(modes, 64).min()
    assert swing > 0.5
    assert drawing.shown(modes, 64).min() > 1.0 - 0.1 * swing
    # the mean is kept
    assert drawing.shown(modes, 64).mean() == pytest.approx(pixels.mean(), rel=1e-3)


GOOD = {"r_hat": [1.0, 1.005], "ess_bulk": [900.0, 800.0], "ess_tail": [700.0, 600.0]}
SAMPLED = {"chains": 4, "divergences": 0}


def warned(sampling=None, **columns):
    table = {name: np.array(values) for name, values in (GOOD | columns).items()}
    names = np.array(["T(centre) [K]", "C_5 [K2]"])
    return warnings_of({"quantity": names, **table}, **SAMPLED | (sampling or {}))


def test_good_draws_are_not_warned_of():
    assert warned() == []
    # what too few draws cannot tell is no reason
    assert warned(r_hat=[np.nan, np.nan]) == []


REASONS = [
    ({"r_hat": [1.002, 1.09]}, ("Not converged", "(1.09)")),
    ({"r_hat": [np.inf, 1.0]}, ("Not converged", "(inf)")),
    ({"r_hat": [1.002, 1.03]}, ("R-hat", "1 of 2", "C_5 [K2] (1.03)", "--draws")),
    ({"ess_bulk": [399.0, 900.0]}, ("bulk", "below 400", "T(centre) [K] (399)")),
    ({"ess_tail": [399.0, 12.0]}, ("tail", "2 of 2", "C_5 [K2] (12)")),
    ({"sampling": {"divergences": 3}}, ("3 trajectories diverged", "--warmup")),
]


@pytest.mark.parametrize(("change", "words"), REASONS)
def test_every_warning_has_its_reason(change, words):
    (found,) = warned(**change)
    assert all(word in found for word in words)


# --- templates: what is missing is an error -------------------------------------------------------


NUMBERS = [(1.234, ".2f", "1.23"), (0.5, ".1%", "50.0%"), (None, ".2f", "-"), (np.nan, "", "-")]


@pytest.mark.parametrize(("value", "form", "text"), NUMBERS)
def test_numbers_are_formatted_and_what_is_missing_is_said(value, form, text):
    assert formatted(value, form, "-") == text
    assert formatted("as it is", form, "-") == "as it is"


def test_probabilities_of_a_column_have_no_equals_sign():
    assert p_value(0.62) == "0.62" and p_value(0.0).startswith("< ")
    assert p_value(np.nan, "no others") == "no others"


def test_what_users_write_cannot_become_tags_and_bad_rows_stand_out():
    text = """{% from "macros.html" import cells, table with context %}
    {%- call(row) table(("a", "b"), rows, [false, true]) %}{{ cells(*row) }}{% endcall %}"""
    page = ENVIRONMENT.from_string(text).render(rows=[("<b>", 1), ("&", 2)])
    assert "<tr><td>&lt;b&gt;</td><td>1</td></tr>" in page
    assert "<tr class=bad><td>&amp;</td><td>2</td></tr>" in page


def test_a_page_without_what_it_shows_is_an_error(tmp_path):
    with pytest.raises(UndefinedError, match="caveat"):
        render("comparison.html", tmp_path, runs=[], rows=[])
    refuse(r"no figures/maps\.png", picture, tmp_path, "maps")
