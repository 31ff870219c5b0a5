"""Programs that cannot be sampled are refused in a sentence, before anything is sampled."""

from pathlib import Path

import pytest

import lusee_bayes
import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.experiment.pieces import program_pieces
from lusee_bayes.sampling.program_checks import require_sampleable

ROOT = Path(lusee_bayes.__file__).resolve().parents[1]

HEAD = """
import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist
from lusee_bayes.sampling.distributions import CorrelatedNormal, SkyPrior

def model(coupling, prior, noise, data=None):
    sky = numpyro.sample("sky", SkyPrior(prior))
    loc = coupling @ sky
"""
TWICE = '    numpyro.deterministic("twice", 2 * sky)\n'
GOOD = '    numpyro.sample("data", CorrelatedNormal(loc, noise), obs=data)\n'

BAD = {
    "raises": ("    raise OSError('no disc')\n" + GOOD, r"fails when it is called \(line 10\): OS"),
    "exits": ("    raise SystemExit(3)\n" + GOOD, "fails when it is called"),
    "twice": ('    numpyro.sample("sky", dist.Normal(0, 1))\n' + GOOD, "sky"),
    "discrete": ('    numpyro.sample("k", dist.Poisson(3))\n' + GOOD, "discrete site 'k'"),
    "slash": ('    numpyro.sample("a/b", dist.Normal(0, 1))\n' + GOOD, "a site 'a/b'"),
    "empty": ('    numpyro.sample("", dist.Normal(0, 1))\n' + GOOD, "a site ''"),
    "dimension": ('    numpyro.sample("chain", dist.Normal(0, 1))\n' + GOOD, "'chain', a name"),
    "derived": ('    numpyro.deterministic("x/y", loc)\n' + GOOD, "a site 'x/y'"),
    "shape": (
        "    data = None if data is None else data[:-1]\n"
        '    numpyro.sample("data", dist.Normal(loc[:-1], 1), obs=data)\n',
        "observes 'data' with shape",
    ),
    "column": (
        '    numpyro.sample("data", dist.Normal(loc[:, None], 1), obs=data)\n',
        "observes 'data' with shape|fails when",
    ),
    "complex": (
        '    numpyro.factor("c", 1j * sky[0])\n' + GOOD,
        "fails when its density is differentiated",
    ),
    "traced": ("    float(sky[0])\n" + GOOD, "fails when it is called"),
    "improper": (
        '    numpyro.sample("u", dist.ImproperUniform(dist.constraints.real, (), ()))\n' + GOOD,
        "fails when",
    ),
    "only with data": (
        '    if data is not None:\n        numpyro.sample("x", dist.Normal(0, 1))\n' + GOOD,
        "samples 'x' only with data",
    ),
    "no data": (
        '    if data is not None:\n        numpyro.sample("data", dist.Normal(loc, 1), obs=data)\n',
        "draws no data where data=None",
    ),
    "unobserved": ('    numpyro.sample("data", dist.Normal(loc, 1))\n', "no observed site 'data'"),
}  # fmt: skip


@pytest.fixture(scope="module")
def pieces():
    scenario = lb.load_scenario("fiducial", ["lmax=2", "observation.runs.0.cycles=0.05"])
    experiment = lb.build(scenario)
    model = lb.infer(experiment).model
    return model, program_pieces(experiment), experiment.data.data


def check(path, pieces):
    model, more, data = pieces
    program = lb.load_program(path)
    arguments = program.arguments(model, more)
    return require_sampleable(program, arguments, data, model.prior.variance().shape[0])


def test_a_good_program_passes(tmp_path, pieces):
    path = tmp_path / "good.py"
    path.write_text(HEAD + '    numpyro.sample("x.y-1", dist.Normal(0, 1))\n' + TWICE + GOOD)
    assert check(path, pieces) == ["sky", "x.y-1"]


@pytest.mark.parametrize(
    "name", ["sky", "sky_marginal", "prior_amplitude", "spectrum_bands", "student_t"]
)
def test_the_packages_programs_pass(name, pieces):
    assert check(name, pieces)


@pytest.mark.parametrize("name", BAD)
def test_bad_programs_are_one_sentence(name, tmp_path, pieces):
    body, message = BAD[name]
    path = tmp_path / "bad.py"
    path.write_text(HEAD + body)
    with pytest.raises(lb.InputError, match=message) as caught:
        check(path, pieces)
    assert "\n" not in str(caught.value) and "bad.py" in str(caught.value)


@pytest.mark.parametrize("argument", ["coupling, /, ", "*, coupling, *noise, ", "**others, "])
def test_arguments_are_given_by_name(argument, tmp_path):
    path = tmp_path / "bad.py"
    path.write_text(f"def model({argument}data=None):\n    pass\n")
    with pytest.raises(lb.InputError, match="does not run|by position, or as many as come"):
        lb.load_program(path)


def test_a_density_that_is_nan_names_the_program(tmp_path, capsys):
    path = tmp_path / "bad.py"
    lines = '    numpyro.factor("bad", jnp.log(-1.0) * sky.sum())\n'
    path.write_text((ROOT / "models" / "sky.py").read_text() + lines + "import jax.numpy as jnp\n")
    small = ["--set", "lmax=3", "--set", "observation.step_s=43200"]
    short = ["--chains", "1", "--warmup", "20", "--draws", "10", "-q"]
    out = str(tmp_path / "out")
    assert main(["sample", "fiducial", *small, "--model", str(path), *short, "-o", out]) == 2
    error = capsys.readouterr().err.strip()
    assert "bad.py" in error and "NaN" in error and "\n" not in error
