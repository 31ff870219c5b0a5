"""What cannot be, said of sources, antennas, priors and treatments: one clear sentence each."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refused
from experiments import program_arguments, small_experiment
from numpyro import handlers

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.experiment.model import base_model, simulate, systematics, true_values
from lusee_bayes.experiment.setup import Setup, mean_flux, source_responses
from lusee_bayes.experiment.sky_sections import SourceSection
from lusee_bayes.experiment.sky_terms import point_sources
from lusee_bayes.sampling.programs import latent_sites
from lusee_bayes.systematics.sky_unknowns import Source, SpectrumBands
from lusee_bayes.systematics.systematic import normal_within
from lusee_bayes.testing.scenarios import small_scenario

CAS_A = "sources.list=[{name: Cas A}]"


def built() -> Setup:
    return small_experiment(CAS_A).setup


def setup_of(*overrides: str) -> Setup:
    """With a scenario of which A and the beams are the same (priors and treatments are not in)."""
    return replace(built(), scenario=small_scenario(CAS_A, *overrides))


def experiment(*overrides: str) -> lb.Experiment:
    setup = setup_of(*overrides)
    return lb.Experiment(setup, simulate(setup))


# --- in the scenario ------------------------------------------------------------------------------


# --- sources --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("{name: Cas B}", "unknown source 'Cas B'; did you mean 'Cas A'?"),
        ("{name: Jupyter}", "unknown source 'Jupyter'; did you mean 'Jupiter'?"),
        ("{name: Q}", "unknown source 'Q'; known: Cas A, Cen A, .*Venus.*ra_deg and dec_deg"),
    ],
)
def test_unknown_sources_name_the_nearest(source, message):
    scenario, setup = small_scenario(f"sources.list=[{source}]"), built()
    with refused(message):
        source_responses(scenario, setup.observation, setup.beam_source, 25.0)


def test_a_source_of_which_nothing_is_known_needs_a_flux():
    """Bodies have no flux in the catalogue; the whole experiment says so."""
    scenario = small_scenario("sources.list=[{name: Jupiter}]")
    with refused("'Jupiter' is not in the catalogue.* give flux_jy"):
        lb.build(scenario)
    own = SourceSection(name="mine", ra_deg=1.0, dec_deg=2.0)
    with pytest.raises(lb.InputError, match="'mine' is not in the catalogue"):
        mean_flux(own, 25.0)


@pytest.mark.parametrize(
    ("columns", "std", "message"),
    [
        (jnp.full((4, 1), np.nan), 1.0, "the response to X holds NaN"),
        (jnp.ones((4, 1)), 0.0, "standard deviation of X's flux must be positive"),
        (jnp.ones((4, 1)), float("nan"), "standard deviation of X's flux must be positive"),
    ],
)
def test_sources_that_cannot_be(columns, std, message):
    with refused(message):
        Source(columns, 1.0, std, "X")


# --- antennas -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("{lenght_m: 0.1}", "unknown beam parameter 'lenght_m'; did you mean 'length_m'?"),
        ("{surface_permitivity: 0.1}", "did you mean 'surface_permittivity'?"),
        ("{x: 1}", "unknown beam parameter 'x'; known: deep_permittivity, .*zenith_angle_deg"),
        # 1 lies 2.7 / 5 standard deviations below: Phi(-0.54) = 29.5 %
        ("{surface_permittivity: 5}", "surface_permittivity.* 29.5% .*at least 1"),
        # Phi(-0.1) = 46 %
        ("{loss_tangent: 0.1}", r"prior of loss_tangent, 0.01 \+- 0.1, has 46.0% .*at least 0"),
        # 105 / 60 standard deviations to 180 degrees, 75 / 60 to 0: 10.6 % and 4.0 %
        ("{zenith_angle_deg: 60}", r"prior of zenith_angle_deg, 75 \+- 60, has 14.6% .*at least 0"),
    ],
)
def test_antennas_that_cannot_be_sampled(parameters, message):
    setup = setup_of(f"noise.beam.parameters={parameters}", "noise.beam.treatment=sampled")
    for ask in (true_values, systematics):
        with refused(message):
            ask(setup)


def test_the_nearer_end_is_named():
    with pytest.raises(lb.InputError, match="at most 180"):
        normal_within("angle", 170.0, 20.0, 0.0, 180.0)
    # a quarter of a percent is allowed: 2.81 standard deviations
    normal_within("angle", 180.0 - 2.82, 1.0, 0.0, 180.0)
    with pytest.raises(lb.InputError, match="0.3% of its weight"):
        normal_within("angle", 180.0 - 2.80, 1.0, 0.0, 180.0)
    with pytest.raises(lb.InputError, match="standard deviation of angle must be positive"):
        normal_within("angle", 1.0, 0.0)


def test_bands_beyond_the_highest_ell():
    e = experiment("prior.band_edges=[3, 7]")
    program = lb.load_program("systematics")
    arguments = {n: v for n, v in program_arguments(program, e).items() if n != "data"}
    with refused("a band begins at ell = 7, above lmax = 6"):
        latent_sites(program.model, arguments)
    # 6 is the highest ell itself
    base = replace(base_model(e.setup), prior=lb.HarmonicPrior(jnp.ones(7)))
    with handlers.seed(rng_seed=0):
        SpectrumBands((3, 6)).sampled(base)


# --- programs that do not fit the scenario --------------------------------------------------------


@pytest.mark.parametrize(
    ("program", "overrides", "section"),
    [
        ("sources", [], "sources"),
        ("gains", ["noise.gain.sigma=0.01"], "noise.gain"),
        ("gain_scales", ["noise.gain.sigma=0.01"], "noise.gain"),
        ("instrument", ["noise.beam.shift_mhz=4"], "noise.beam"),
        ("instrument", ["noise.beam.parameters={length_m: 0.1}"], "noise.beam"),
    ],
)
def test_nothing_is_counted_twice(program, overrides, section):
    """What a program samples must not be in N as well."""
    asked = lb.load_program(program)
    e = experiment(*overrides)
    wanted = f"would count twice; set {section}.treatment=sampled"
    with refused(wanted):
        program_arguments(asked, e)
    # either of the other treatments will do
    for treatment in ("sampled", "ignored"):
        free = experiment(*overrides, f"{section}.treatment={treatment}")
        assert program_arguments(asked, free)


def test_what_the_scenario_does_not_have():
    bare = small_experiment()
    for ask, message in (
        (
            lambda: program_arguments(lb.load_program("gains"), bare),
            "the scenario has no noise.gain",
        ),
        (lambda: program_arguments(lb.load_program("sources"), bare), "has no sources.list"),
        (lambda: point_sources(bare.setup), "the scenario has no sources.list"),
    ):
        with refused(message):
            ask()


def test_pieces_of_an_experiment_need_one():
    with refused("asks for 'gaussian', a piece of an experiment"):
        lb.load_program("systematics").arguments(base_model(built()))


# --- commands -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "override",
    [
        "sources={list: [{name: Cas A}], treatment: sampled}",
        "noise.gain={treatment: sampled}",
        "noise.beam={shift_mhz: 4, treatment: sampled}",
        "noise.radiometer.log_factor_std=0.5",
        "prior.tilt_std=0.5",
        "prior.log_amplitude_std=0.5",
        "prior.band_edges=[2, 4]",
    ],
)
def test_a_map_cannot_sample(override, tmp_path, capsys):
    arguments = ["map", "fiducial", "-o", str(tmp_path / "out")]
    for setting in ("lmax=6", "observation.runs.0.cycles=0.02", "sky.sources=false", override):
        arguments += ["--set", setting]
    assert main(arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.endswith("a map can only marginalise; use: lusee-bayes sample")
    assert not (tmp_path / "out").exists()
