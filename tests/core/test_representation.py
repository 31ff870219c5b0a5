"""What objects say of themselves: few lines with shapes, units, frequency and dates."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

import lusee_bayes as lb
from lusee_bayes.core.checks import Described, listed


class Shown(Described):
    def description(self):
        return "T < 3 K & more", "second"


def test_text_and_html():
    assert repr(Shown()) == "Shown: T < 3 K & more\n  second"
    assert Shown()._repr_html_() == "<div><b>Shown</b>: T &lt; 3 K &amp; more<br>second</div>"
    assert listed(tuple("abcdefghijkl")) == "a, b, c, d, ..., k, l"


def objects(small_map, small_cube):
    experiment = small_map.result.experiment
    inference = small_map.result.inference
    setup = experiment.setup
    return [
        (experiment.data, ["16 products", "25 MHz", "K", "00R, 01R", "2027-01-15"]),
        (setup.observation, ["182.258", "7200 s", "0, 30 degrees"]),
        (setup.layout, ["16 products"]),
        (setup.beams, ["16 products", "25 MHz", "lmax = 8", "81 real"]),
        (setup.sky, ["embedded Galaxy", "25 MHz", "lmax = 8", " K"]),
        (setup.prior, ["lmax = 8", "K^2"]),
        (setup.coupling, ["81 unknowns", f"{experiment.data.layout.size} data"]),
        (inference.model.noise, ["K^2", f"{experiment.data.layout.size} data"]),
        (inference.model, ["d = A m + n", "HarmonicPrior"]),
        (inference.posterior, ["81 unknowns", "ln evidence", "bits"]),
        (experiment, ["25 MHz", "lmax = 8", "monopole"]),
        (small_map.result.channel, ["25 MHz", "NSIDE", "mean", " K"]),
        (small_map.result, ["25 MHz", "chi2", "bits"]),
        (small_cube.result, ["3 independent channels, 20 to 30 MHz"]),
    ]


def test_objects_say_what_they_are(small_map, small_cube):
    for thing, words in objects(small_map, small_cube):
        text, html = repr(thing), thing._repr_html_()
        assert text.startswith(type(thing).__name__)
        assert all(word in text and word in html for word in words), text
        assert 1 <= len(text.splitlines()) <= 5
        assert max(map(len, text.splitlines())) <= 120


def test_what_is_traced_has_a_representation():
    seen = []

    @eqx.filter_jit
    def look(sky, prior):
        seen.append(repr(sky) + repr(prior))
        return sky.modes

    look(lb.Sky(jnp.ones(4), 25.0), lb.HarmonicPrior(jnp.ones(2)))
    assert "traced" in seen[0]
    assert "1.00" not in seen[0]
    assert len(seen) == 1
