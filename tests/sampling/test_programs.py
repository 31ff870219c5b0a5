"""Programs: found and refused in one sentence; skies and data drawn from collapsed ones."""

import hashlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse, refused
from experiments import density
from numpyro import handlers
from reference_linear import assert_draws_follow, posterior
from small_models import random_gaussian
from tables import tables

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.experiment.experiment import program_pieces
from lusee_bayes.sampling import programs

TABLES = tables(__file__)

SPECTRUM = np.array([4.0, 1.0, 0.5])
ELL_OF_MODE = np.repeat([0, 1, 2], [1, 3, 5])
N_DATA = 12
OFFSET = np.linspace(-3.0, 3.0, N_DATA)

# the sky integrated out, with an offset, a deterministic site and a vector site
OFFSET_PROGRAM = """
import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb


def model(coupling, prior, noise, data=None):
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    gains = numpyro.sample("gains", dist.LogNormal(jnp.zeros(2), 1.0).to_event(1))
    total = numpyro.deterministic("total", gains.sum())
    offset = slope * jnp.linspace(-3.0, 3.0, coupling.shape[0])
    gaussian = lb.LinearGaussian(coupling, prior, noise.scaled(total), offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
"""


@pytest.fixture(scope="module")
def gaussian():
    return random_gaussian(SPECTRUM, N_DATA, 11, noise=3.0)


WRITTEN = "mine.py"


# --- finding them ---------------------------------------------------------------------------------


def test_a_program_by_its_path(write):
    text = "def model(noise, coupling, data=None):\n    return 'mine'\n"
    path = write(text)
    for source in (path, str(path)):
        program = lb.load_program(source)
        assert program.name == "mine"
        assert program.model(None, None) == "mine"
        assert program.digest == hashlib.sha256(text.encode()).hexdigest()


def test_a_file_named_like_a_program_is_meant_only_by_its_path(write, monkeypatch, tmp_path):
    path = write("def model(data=None):\n    return 'mine'\n", "sky.py")
    monkeypatch.chdir(tmp_path)
    first, again, mine = (lb.load_program(source).digest for source in ("sky", "sky", path))
    assert first == again != mine
    assert lb.load_program("sky.py").model() == "mine"


@pytest.mark.parametrize("bytecode", [True, False])
def test_the_text_that_was_digested_is_the_one_that_runs(write, monkeypatch, bytecode):
    """Edits within one second and of the same length: bytecode caches cannot tell them apart."""
    monkeypatch.setattr(sys, "dont_write_bytecode", not bytecode)
    for i in range(4):
        assert lb.load_program(write(f"def model(data=None):\n    return {i}\n")).model() == i


def test_a_program_may_hold_dataclasses_and_modules(write):
    """Both look up the module that they are defined in."""
    path = write(
        "from dataclasses import dataclass\n"
        "import equinox as eqx\n"
        "@dataclass\n"
        "class Settings:\n"
        "    scale: float = 2.0\n"
        "class Gains(eqx.Module):\n"
        "    level: float = 3.0\n"
        "def model(data=None):\n"
        "    return Settings().scale * Gains().level\n"
    )
    assert lb.load_program(path).model() == 6.0


def test_a_program_has_its_own_future_imports_only(write):
    """Annotations are strings in the package's modules, in a program only if it says so."""
    path = write("def model(data: 1 + 1 = None):\n    pass\n")
    assert lb.load_program(path).model.__annotations__ == {"data": 2}


# --- and refusing them ----------------------------------------------------------------------------


def test_no_such_program(tmp_path):
    for source in ("sky_margnal", tmp_path / "missing.py", tmp_path):
        refuse(rf"no program.*{re.escape(str(source))}.*sky_marginal", lb.load_program, source)


@pytest.mark.parametrize(("text", "message", "more"), TABLES["no programs"])
def test_files_that_are_no_programs(write, text, message, more):
    path = write(text)
    with refused(message) as error:
        lb.load_program(path)
    assert str(path) in str(error.value) and more in str(error.value)
    assert len(str(error.value)) < 300
    refuse("path.*Python file", lb.load_program, write(text, "mine.txt"))


# --- what they ask for ----------------------------------------------------------------------------


def test_arguments_are_what_the_signature_names(write, gaussian):
    program = lb.load_program(write("def model(prior, data=None, *, noise, coupling):\n    pass\n"))
    arguments = program.arguments(gaussian)
    assert list(arguments) == ["prior", "noise", "coupling"]
    for name in arguments:
        assert arguments[name] is getattr(gaussian, name)
    program = lb.load_program(write("def model(fixed_noise, data=None):\n    pass\n"))
    (factor,) = program.arguments(gaussian).values()
    identity = np.asarray(factor.solve(gaussian.noise.dense()))
    np.testing.assert_allclose(identity, np.eye(N_DATA), atol=1e-12)
    assert lb.load_program(write("def model(data=None):\n    pass\n")).arguments(gaussian) == {}


def test_which_programs_have_integrated_the_sky_out(write, gaussian):
    data, found = np.asarray(gaussian.sample(jax.random.key(0))[1]), {}
    for name in ("sky", "sky_marginal", "prior_amplitude"):
        program = lb.load_program(name)
        found[name] = programs.is_collapsed(program, program.arguments(gaussian), data)
    assert found == {"sky": False, "sky_marginal": True, "prior_amplitude": True}
    mine = lb.load_program(write(OFFSET_PROGRAM))
    assert programs.is_collapsed(mine, mine.arguments(gaussian), data)
    kept = lb.load_program(write(OFFSET_PROGRAM.replace("return gaussian", "return None")))
    assert not programs.is_collapsed(kept, kept.arguments(gaussian), data)


NAMES = ["sky", "sky_marginal", "prior_amplitude", "spectrum_bands"]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_seen_without_a_sky_shifts_the_data(gaussian, name):
    """p(d + offset | with an offset) = p(d | without), whatever the sites."""
    program, offset = lb.load_program(name), jnp.asarray(100.0 * OFFSET)
    shifted = replace(gaussian, offset=offset)
    data = gaussian.sample(jax.random.key(4))[1]
    with programs.numpyro_promotion():
        seeded = handlers.seed(program.model, jax.random.key(5))
        sites = handlers.trace(seeded).get_trace(**program.arguments(gaussian))
    values = {k: v["value"] for k, v in sites.items() if k != "data"}
    expected, found, other = (
        density(program, program.arguments(model) | {"data": d}, values)[0]
        for model, d in ((gaussian, data), (shifted, data + offset), (shifted, data))
    )
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    assert abs(other - expected) > 1.0


def test_a_program_that_would_forget_the_offset_is_refused(gaussian, write):
    program = lb.load_program(write("def model(coupling, data=None):\n    pass\n"))
    program.arguments(gaussian)
    shifted = replace(gaussian, offset=jnp.asarray(OFFSET))
    refuse("'mine'.* add 'offset'", program.arguments, shifted)


# --- draws from collapsed programs ----------------------------------------------------------------


def repeated(values, shape=(2, 5000)):
    """The same values of the sites at every draw."""
    return {name: np.broadcast_to(v, (*shape, *np.shape(v))) for name, v in values.items()}


@pytest.fixture(scope="module")
def collapsed(gaussian, tmp_path_factory):
    """By name: (program, fixed values of its sites, S, N and the offset at these values)."""
    path = tmp_path_factory.mktemp("programs") / "offset.py"
    path.write_text(OFFSET_PROGRAM)
    s, n = np.diag(SPECTRUM[ELL_OF_MODE]), np.asarray(gaussian.noise.dense())
    steeper = 2.5 * ((ELL_OF_MODE + 1.0) / 10.0) ** -0.6
    values = {"slope": 1.5, "gains": np.array([0.5, 1.2]), "total": 1.7}
    made = {
        "prior_amplitude": ({"amplitude": 2.5, "tilt": -0.6}, s * steeper, n, 0.0),
        "sky_marginal": ({"noise_level": 0.4}, s, 0.4 * n, 0.0),
        path: (values, s, 1.7 * n, 1.5 * OFFSET),
    }
    loaded = {source: lb.load_program(source) for source in made}
    return {program.name: (program, *made[source]) for source, program in loaded.items()}


each = pytest.mark.parametrize("name", ["prior_amplitude", "sky_marginal", "offset"])


@each
def test_skies_at_fixed_sites_follow_the_analytic_posterior(gaussian, collapsed, name):
    program, values, s, n, offset = collapsed[name]
    data = np.asarray(gaussian.sample(jax.random.key(1))[1])
    arguments = program.arguments(gaussian)
    skies = programs.collapsed_draws(program, arguments, data, repeated(values), jax.random.key(2))
    assert isinstance(skies, np.ndarray) and skies.shape == (2, 5000, 9)
    expected = posterior(gaussian.coupling.dense(), s, n, data, offset)
    assert_draws_follow(skies.reshape(-1, 9), expected.mean, expected.covariance)


@each
def test_replicated_data_are_the_skies_seen_with_new_noise(gaussian, collapsed, name):
    program, values, _, n, offset = collapsed[name]
    sky, data = (np.asarray(x) for x in gaussian.sample(jax.random.key(6)))
    skies = np.broadcast_to(sky, (2, 5000, 9))
    given = program, program.arguments(gaussian), data, repeated(values), jax.random.key(7)
    seen = programs.collapsed_draws(*given, skies)
    assert seen.shape == (2, 5000, N_DATA)
    mean = np.asarray(gaussian.coupling.dense()) @ sky + offset
    assert_draws_follow(seen.reshape(-1, N_DATA), mean, n)
    # noise sqrt(1.2) too strong, or a mean 0.1 standard deviations off, would be seen


# --- programs that cannot be sampled --------------------------------------------------------------


ROOT = Path(lb.__file__).resolve().parents[1]

HEAD = """
import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist
from lusee_bayes.sampling.distributions import CorrelatedNormal, SkyPrior

def model(coupling, prior, noise, data=None):
    sky = numpyro.sample("sky", SkyPrior(prior))
    loc = coupling @ sky
"""
GOOD = 'numpyro.sample("data", CorrelatedNormal(loc, noise), obs=data)'


def text_of(*lines):
    """Lines that follow the head, one of which observes the data where it says GOOD."""
    return HEAD + "".join(f"    {GOOD if line == 'GOOD' else line}\n" for line in lines)


@pytest.fixture(scope="module")
def pieces():
    scenario = lb.load_scenario("fiducial", ["lmax=2", "observation.runs.0.cycles=0.05"])
    experiment = lb.build(scenario)
    return lb.infer(experiment).model, program_pieces(experiment), experiment.data.data


def check(path, pieces):
    model, more, data = pieces
    program = lb.load_program(path)
    arguments = program.arguments(model, more)
    return programs.require_sampleable(program, arguments, data, model.prior.variance().shape[0])


def test_a_good_program_passes(write, pieces):
    twice = 'numpyro.deterministic("twice", 2 * sky)'
    path = write(text_of('numpyro.sample("x.y-1", dist.Normal(0, 1))', twice, "GOOD"))
    assert check(path, pieces) == ["sky", "x.y-1"]


@pytest.mark.parametrize("name", [*NAMES, "student_t"])
def test_the_packages_programs_pass(name, pieces):
    assert check(name, pieces)


TEXTS = {name: (text_of(*body), said) for name, (*body, said) in TABLES["bad programs"].items()}
TEXTS["no sky"] = text_of("GOOD").replace('"sky"', '"mine"'), "has no site 'sky'"
KNOWN = re.sub(r'numpyro.sample\("(slope|gains)".*', "jnp.ones(1)", OFFSET_PROGRAM)
TEXTS["no unknowns"] = KNOWN, "no latent site"


@pytest.mark.parametrize("name", TEXTS)
def test_bad_programs_are_one_sentence(name, write, pieces):
    text, message = TEXTS[name]
    with refused(message) as caught:
        check(write(text, "bad.py"), pieces)
    assert "bad.py" in str(caught.value)


@pytest.mark.parametrize("argument", ["coupling, /, ", "*, coupling, *noise, ", "**others, "])
def test_arguments_are_given_by_name(argument, write):
    path = write(f"def model({argument}data=None):\n    pass\n")
    refuse("fails.*loaded|positional.*starred argument", lb.load_program, path)


def test_a_density_that_is_nan_names_the_program(tmp_path, capsys):
    path = tmp_path / "bad.py"
    lines = '    numpyro.factor("bad", jnp.log(-1.0) * sky.sum())\n'
    path.write_text((ROOT / "models" / "sky.py").read_text() + lines + "import jax.numpy as jnp\n")
    small = ["--set", "lmax=2", "--set", "observation.step_s=172800"]
    short = ["--chains", "1", "--warmup", "20", "--draws", "10", "-q"]
    out = str(tmp_path / "out")
    assert main(["sample", "fiducial", *small, "--model", str(path), *short, "-o", out]) == 2
    error = capsys.readouterr().err.strip()
    assert "bad.py" in error and "NaN" in error and "\n" not in error
