"""A against integrals over the sky, rows and rotations; and A of antennas that vary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, refuse
from numpyro import handlers
from reference import arm_response, hemisphere, steep_sky, vectors, visibilities
from scipy.stats import norm, truncnorm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import Rotation, n_modes, turn_about_z
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.beams.monopoles import Monopoles, Regolith
from lusee_bayes.instrument.coupling import CouplingMatrix, DenseCoupling, Instrument
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout, auto_indices, labels
from lusee_bayes.linear.joint_model import ChannelCouplings
from lusee_bayes.systematics.beam import BeamError, InstrumentParameters
from lusee_bayes.systematics.systematic import Unknown
from lusee_bayes.testing import check_coupling

LMAX = 8
SITE = {"lon_deg": 182.258, "lat_deg": -23.814}


def random_beams(seed, lmax=LMAX, n_products=16):
    modes = np.random.default_rng(seed).standard_normal((n_products, n_modes(lmax)))
    return ProductBeams(modes, 25.0)


def two_runs():
    return lb.Observation.from_runs([lb.Run(0.3), lb.Run(0.2, 30.0)], step_s=30000.0)


@pytest.fixture(scope="module")
def coupling():
    return CouplingMatrix.observe(random_beams(1), two_runs())


TURNTABLES = [pytest.param(16, 0.0, marks=pytest.mark.long), (8, 35.0)]


@pytest.mark.parametrize(("lmax", "turntable"), TURNTABLES)
def test_visibilities_agree_with_an_integral_over_the_sky_in_lunartopo(lmax, turntable):
    frequency, o = 25.0, lb.Observation.from_runs([lb.Run(1.0, turntable)])
    sky = steep_sky(lmax)
    got = CouplingMatrix.observe(lb.monopole_beams(frequency, lmax), o) @ sky
    got = np.asarray(got).reshape(16, -1)
    grid = theta, phi, solid_angle = hemisphere(32, 64)
    # the antennas one direction at a time, reflection included
    s, p = Monopoles().regolith.reflection(np.cos(theta), frequency)
    ground = [(complex(x), complex(y)) for x, y in zip(s, p, strict=True)]
    antenna = {"frequency_mhz": frequency, "length": 3.0, "height": 2.0, "steps": 121}
    arms = vectors(np.full(4, np.radians(75.0)), np.radians([90.0, 0.0, 270.0, 180.0]))
    each = list(zip(theta, phi, ground, strict=True))
    voltages = [
        [arm_response(t, f, arm=arm, reflection=r, **antenna) for t, f, r in each]
        for arm in arms  # North, East, South, West
    ]
    e = np.array(voltages)  # (antenna, direction, component)
    power = np.einsum("idc,jdc->ijd", e, e.conj()) / 2
    power /= np.mean([np.sum(power[i, i].real * solid_angle) for i in range(4)])
    parts = {"R": np.real, "I": np.imag}
    response = np.array([parts[x[2]](power[int(x[0]), int(x[1])]) for x in labels()])
    site = {**SITE, "turntable_deg": turntable}
    for k in np.random.default_rng(2).integers(0, o.n_times, 3):
        # Simpson with 120 steps along the arm, (k h)^4 / 180 = 1e-10, and the neglected tilts
        close(got[:, k], visibilities(response, grid, np.asarray(sky), o.times[k], **site), 5e-9)


def flagged():
    """Two runs of random beams with three samples in ten missing, and the matrix row by row, which
    neither products nor ``dense`` use."""
    o = two_runs()
    layout = DataLayout.from_flags(np.random.default_rng(6).random((16, o.n_times)) < 0.3)
    made = CouplingMatrix.build(random_beams(5, 2), Pointing.of(o, 2), layout)
    return made, np.asarray(made.rows(layout.product, layout.time))


def given(n_data, n_unknowns):
    matrix = np.random.default_rng(n_data).standard_normal((n_data, n_unknowns))
    return DenseCoupling(matrix), matrix


def channels():
    """Two channels with three maps, of which the last is only in the second."""
    parts, mixing = [given(n, 4)[1] for n in (9, 3)], np.array([[1.0, 0.5, 0.0], [2.0, -1.0, 1.0]])
    made = ChannelCouplings(tuple(map(jnp.asarray, parts)), jnp.asarray(mixing))
    written = [np.kron(row, part) for row, part in zip(mixing[:, None], parts, strict=True)]
    return made, np.concatenate(written)


KINDS = {"structured": flagged, "dense": lambda: given(9, 16), "tall": lambda: given(30, 5)}
KINDS["channels"] = channels


@pytest.mark.parametrize("made", KINDS.values(), ids=list(KINDS))
def test_contract(made):
    check_coupling(*made())


def test_dense_rows_are_each_times_own_rotation(coupling):
    """V = b . D(topocentric <- galactic at t) a, with one dense rotation for every time."""
    o = two_runs()
    dense = np.asarray(coupling.dense()).reshape(16, o.n_times, -1)
    a, beams = steep_sky(LMAX, monopole=1.0), random_beams(1).modes
    for k in (0, 5, o.n_times - 1):
        seen = Rotation.from_matrix(o.topocentric_from_mcmf() @ o.mcmf_from_galactic[k], LMAX)(a)
        expected = np.asarray(turn_about_z(beams, np.radians(o.turntable_deg[o.run[k]])) @ seen)
        # the neglected third order of the tilts: (1e-3)^3 of low modes
        close(dense[:, k] @ np.asarray(a), expected, 1e-8)


@pytest.mark.long
@pytest.mark.parametrize(("cycles", "lmax"), [pytest.param(1, 47, marks=pytest.mark.long), (3, 12)])
def test_the_moons_axis_is_not_fixed(cycles, lmax, monkeypatch):
    """Orders of the tilt expansion in units of the fiducial radiometer noise (DESIGN 5)."""
    o = lb.Observation.from_runs([lb.Run(1.0)] * cycles, step_s=20000.0)
    beams, sky = lb.monopole_beams(25.0, lmax), steep_sky(lmax)

    def visibilities_at(order=None):
        return np.asarray(CouplingMatrix.build(beams, Pointing.of(o, lmax, order)) @ sky)

    monkeypatch.setattr("lusee_bayes.instrument.averaging.TOLERANCE", 1e-14)
    exact = visibilities_at(5)  # itself good to 1e-9 sigma
    v = exact.reshape(16, -1)
    autos = v[auto_indices()]
    first, second = (np.array([int(x[i]) for x in labels()]) for i in (0, 1))
    sigma = np.sqrt((autos[first] * autos[second] + v**2) / (2 * 1e6 * 7200.0)).ravel()

    def off(order=None):
        return np.abs((visibilities_at(order) - exact) / sigma)

    growth = (0.083 / 0.044) if cycles == 3 else 1.0  # the wander of the axis
    assert off(0).max() > 1.0
    assert np.sqrt(np.mean(off(0) ** 2)) > 0.3
    assert off(1).max() < 0.02 * growth**2 and off(2).max() < 1e-5 * growth**3
    monkeypatch.undo()
    # by default, and with the fewest functions of time
    assert off().max() < 1e-6


# --- A of many beams, antennas placed by name, beam errors ----------------------------------------


FREQUENCY, LOW = 25.0, 4
STDS = {"surface_permittivity": 0.3, "zenith_angle_deg": 2.0, "turntable_offset_deg": 1.0}


@pytest.fixture(scope="module")
def pointing():
    """Two runs at two turntable angles: 18 samples."""
    observation = lb.Observation.from_runs([lb.Run(0.3, 0.0), lb.Run(0.4, 40.0)], step_s=86400.0)
    return Pointing.of(observation, LOW)


@pytest.fixture(scope="module")
def layout(pointing):
    flags = np.zeros((16, pointing.n_times), bool)
    flags[3, 2:5] = flags[:, 7] = True
    return DataLayout.from_flags(flags)


@pytest.fixture(scope="module")
def instrument(pointing, layout):
    return Instrument(Monopoles(), pointing, layout, FREQUENCY, LOW)


PLACED = {"length_m": 3.1, "height_m": 1.7, "zenith_angle_deg": 73.0, "turntable_offset_deg": 5.0}
PLACED |= {"surface_permittivity": 3.5, "deep_permittivity": 6.5, "loss_tangent": 0.02}


def test_a_of_placed_antennas_is_that_of_antennas_built_so(instrument, pointing, layout):
    geometry = {"length_m": 3.1, "height_m": 1.7, "zenith_angle_deg": 73.0}
    geometry["azimuths_deg"] = np.array([90.0, 0.0, -90.0, 180.0]) + 5.0
    beams = lb.monopole_beams(FREQUENCY, LOW, Monopoles(Regolith(3.5, 6.5, 0.02), **geometry))
    expected = np.asarray(lb.CouplingMatrix.build(beams, pointing, layout).dense())
    placed = {name: jnp.asarray(value) for name, value in PLACED.items()}
    close(instrument.coupling(placed).dense(), expected, 1e-13)
    # and every one of them matters
    for name, value in PLACED.items():
        others = placed | {name: instrument.value(name)}
        away = np.abs(np.asarray(instrument.coupling(others).dense()) - expected).max()
        assert away > 1e-4 * np.abs(expected).max(), (name, value)


@pytest.fixture(scope="module")
def base(instrument):
    coupling = instrument.coupling()
    prior = lb.HarmonicPrior(1e6 / (1.0 + jnp.arange(LOW + 1.0)) ** 2)
    noise = lb.DiagonalCovariance(jnp.full(coupling.shape[0], 4.0))
    return lb.LinearGaussian(coupling, prior, noise)


def test_sites_of_the_antennas_parameters(instrument, base):
    """Priors cut off at the ends of the domain; A is that of the values."""
    known = {name: instrument.source.parameter(name) for name in STDS}
    bounds = {k: {"low": float(p.low), "high": float(p.high)} for k, p in known.items()}
    priors = (Unknown(k, float(p.value), STDS[k], **bounds[k]) for k, p in known.items())
    systematic = InstrumentParameters(tuple(priors), instrument)
    values = {"surface_permittivity": 3.2, "zenith_angle_deg": 76.0, "turntable_offset_deg": -0.4}
    arrays = {name: jnp.asarray(value) for name, value in values.items()}
    with (
        jax.numpy_dtype_promotion("standard"),
        handlers.trace() as trace,
        handlers.seed(rng_seed=0),
        handlers.substitute(data=arrays),
    ):
        model = systematic.sampled(base)
        got = {name: float(site["fn"].log_prob(site["value"])) for name, site in trace.items()}
    close(model.coupling.dense(), instrument.coupling(arrays).dense(), 1e-13)
    expected = {
        "surface_permittivity": truncnorm.logpdf(3.2, (1 - 3.7) / 0.3, np.inf, 3.7, 0.3),
        "zenith_angle_deg": truncnorm.logpdf(76.0, -75 / 2, 105 / 2, 75.0, 2.0),
        "turntable_offset_deg": norm.logpdf(-0.4, 0.0, 1.0),
    }
    assert got == pytest.approx(expected, rel=1e-10)


def test_the_amplitude_of_a_beam_error(instrument, base, pointing, layout):
    other, own = lb.monopole_beams(29.0, LOW), instrument.beams()
    error = BeamError(CouplingMatrix.of_modes(other.modes - own.modes, pointing, layout))
    sky = base.prior.sample(jax.random.key(3))
    for amplitude in (0.0, 0.7, 1.0):
        value = {"beam_amplitude": jnp.asarray(amplitude)}
        with handlers.trace() as trace, handlers.seed(rng_seed=0), handlers.substitute(data=value):
            model = error.sampled(base)
        mixed = ProductBeams((1 - amplitude) * own.modes + amplitude * other.modes, FREQUENCY)
        expected = CouplingMatrix.build(mixed, pointing, layout)
        # linear in the beams, as a product and as a matrix
        close(model.coupling @ sky, expected @ sky, 1e-12)
        close(model.coupling.dense(), expected.dense(), 1e-13)
        fn = trace["beam_amplitude"]["fn"]
        assert float(fn.log_prob(amplitude)) == pytest.approx(norm.logpdf(amplitude))


# --- refusals -------------------------------------------------------------------------------------


def test_what_cannot_be_is_refused(coupling, instrument, base, pointing):
    two = Pointing.of(two_runs(), LMAX)
    refuse("beam coefficients has shape", CouplingMatrix.build, random_beams(0, lmax=5), two)
    layout = DataLayout(4, 7)
    refuse("layout.*4 products.*7 times", CouplingMatrix.build, random_beams(0), two, layout)
    for product, time, words in ((16, 0, "product numbers must"), (0, -1, "time numbers must")):
        refuse(words, coupling.rows, np.array([product]), np.array([time]))
    words = "unknown beam parameter 'lenght_m'; did you mean 'length_m'"
    refuse(words, instrument.source.with_values, {"lenght_m": 0.1})
