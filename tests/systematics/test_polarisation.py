"""Polarised emission that the map does not model: its response, its covariance, and what it costs.

The oracles are sums over pixels of healpy's Q and U, turned from the Galactic basis to that of the
antennas by vectors, with the fields in these directions; and, for V, the double integral of the
patterns with the correlation function. Neither has harmonics of beams or rotations of modes.
"""

from dataclasses import replace

import healpy
import jax
import numpy as np
import pytest
from assertions import close, off, refuse
from experiments import rms_of_directions
from numpy.polynomial.legendre import legval

import lusee_bayes as lb
from lusee_bayes.core.harmonics import n_modes, to_healpy
from lusee_bayes.experiment.model import model_about, set_up, simulate, true_signal, true_values
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.fields import HemisphereGrid, beam_scale, product_modes
from lusee_bayes.instrument.beams.luseepy_files import read_response
from lusee_bayes.instrument.beams.monopoles import Monopoles, beams_towards
from lusee_bayes.instrument.beams.sampled import sampled_beams
from lusee_bayes.instrument.products import all_products
from lusee_bayes.systematics.context import Around
from lusee_bayes.testing import small_scenario

LMAX, MHZ = 6, 25.0
# two instants, with the antennas turned between them
RUNS = "[{cycles: 0.004}, {cycles: 0.004, turntable_deg: 40}]"
SHORT = (f"observation.runs={RUNS}", "observation.window=instant")


def setup_with(*overrides, **section):
    tree = small_scenario(*SHORT, *overrides).model_dump()
    tree["noise"]["polarisation"] = {"lmax": LMAX} | section
    return set_up(Scenario.model_validate(tree))


def root_of(setup):
    """U, (products, times, rank), in K."""
    (found,) = model_about(setup, Around())[1]
    root = found.systematic.root
    return np.asarray(root).reshape(16, -1, root.shape[1])


def spectrum(setup, rms, lowest):
    """C_ell in K^2 of a field with this rms over the mean of the sky."""
    ell = np.arange(LMAX + 1)
    shape = np.where(ell >= lowest, (ell + 1.0) ** setup.scenario.noise.polarisation.slope, 0.0)
    mean = float(setup.sky.modes[0]) / np.sqrt(4.0 * np.pi)
    return (rms * mean) ** 2 * shape * 4.0 * np.pi / np.sum((2 * ell + 1) * shape)


def basis(n):
    """Unit vectors along theta and phi, (directions, 3)."""
    phi = np.cross([0.0, 0.0, 1.0], n)
    phi /= np.linalg.norm(phi, axis=1, keepdims=True)
    return np.cross(phi, n), phi


def seen_by_pixels(setup, q, u):
    """Visibilities of Galactic maps of Q and U, a sum over pixels above the horizon."""
    n = np.array(healpy.pix2vec(healpy.get_nside(q), np.arange(len(q)))).T
    axes, seen = np.array([setup.observation.antenna_directions(x) for x in np.eye(3)]), []
    for turn in np.moveaxis(axes, 0, 2):  # from Galactic vectors to those of the antennas
        here = n @ turn.T
        here /= np.linalg.norm(here, axis=1, keepdims=True)
        theta, phi = basis(here)
        along = basis(n)[0] @ turn.T
        angle = np.arctan2((along * phi).sum(1), (along * theta).sum(1))
        turned = (q + 1j * u) * np.exp(2j * angle)
        beams = [beams_towards(MHZ, here, stokes=stokes) for stokes in "QU"]
        seen.append(beams[0] @ turned.real + beams[1] @ turned.imag)
    return 4.0 * np.pi / len(q) * np.array(seen).T


def test_the_response_to_linear_polarisation_is_that_of_a_sum_over_pixels():
    setup = setup_with(linear=0.02, slope=-1.0)
    root, n = root_of(setup), n_modes(LMAX) - 4
    assert root.shape == (16, 2, 2 * n)
    z = np.random.default_rng(3).normal(size=(2, n))
    std = np.sqrt(np.repeat(spectrum(setup, 0.02, 2) / 2.0, 2 * np.arange(LMAX + 1) + 1))
    modes = [to_healpy(std * np.concatenate([np.zeros(4), one])) for one in z]
    expected = seen_by_pixels(setup, *healpy.alm2map_spin(modes, 128, 2, LMAX))
    assert off(root @ z.ravel(), expected) < 1e-4  # the horizon cuts pixels
    # what turns E into B changes nothing in N: these two would be swapped
    assert off(root @ z[::-1].ravel(), expected) > 0.1


def test_the_covariance_is_that_of_any_orientation():
    """Of one instant: the sky is isotropic, and the antennas see it alike from everywhere."""
    for section in ({"linear": 0.01}, {"circular": 0.01}):
        root = root_of(setup_with(**section))
        first, second = (root[:, t] @ root[:, t].T for t in (0, 1))
        close(first, second, 1e-9)
        assert off(root[:, 0], root[:, 1]) > 0.1


def test_the_covariance_of_circular_polarisation_is_a_double_integral():
    """Of the patterns with the correlation of V: sum_l (2 l + 1) / (4 pi) C_l P_l(n . n')."""
    setup = setup_with(circular=0.03, slope=-1.0)
    grid = HemisphereGrid.gauss_legendre(24, 48)
    theta, phi = (x.ravel() for x in np.meshgrid(grid.theta, grid.phi, indexing="ij"))
    n = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]).T
    weights = np.repeat(grid.weights, grid.n_phi) * 2.0 * np.pi / grid.n_phi
    patterns = np.asarray(beams_towards(MHZ, n, stokes="V")) * weights
    series = (2 * np.arange(LMAX + 1) + 1) / (4.0 * np.pi) * spectrum(setup, 0.03, 0)
    root = root_of(setup)[:, 1]
    close(root @ root.T, patterns @ legval(n @ n.T, series) @ patterns.T, 1e-8)


def test_fields_have_the_beam_scale_beams(response_file):
    grid, antennas = HemisphereGrid.for_lmax(LMAX), Monopoles()
    fields = antennas.fields(MHZ, grid)
    scale, absolute = beam_scale(fields, antennas.beams(MHZ, LMAX)), read_response(response_file)
    close(scale * product_modes(fields, 3, normalise=False), product_modes(fields, 3), 1e-12)
    assert abs(beam_scale(absolute.fields(20.0, grid), absolute.beams(20.0, LMAX)) - 1.0) < 1e-4


def test_simulated_data_hold_a_draw_of_it_and_gains_multiply_it():
    setup = setup_with(linear=0.01, circular=0.02, treatment="ignored")
    none = setup_with()  # with linear and circular zero there is nothing of it
    assert model_about(setup, Around())[1] == model_about(none, Around())[1] == ()
    treated = setup_with(linear=0.01, circular=0.02)
    drawn = root_of(treated) @ true_values(setup)["polarisation_noise"]
    for one in (setup, treated):
        close((simulate(one).data - simulate(none).data).reshape(16, 2), drawn, 1e-8)
    gains = "noise.gain_table={std: 0.05, treatment: ignored}"
    both = setup_with(gains, linear=0.01, circular=0.02)
    alone = replace(setup, scenario=small_scenario(*SHORT, gains))
    both, alone = (true_signal(one, true_values(one)) for one in (both, alone))
    close(both, alone * (1.0 + drawn / true_signal(none, {})), 1e-9)
    assert off(both, alone) > 1e-3


def test_gains_that_are_found_multiply_it_in_n():
    setup = setup_with("noise.gain_table={std: 0.05}", linear=0.01)
    alone = model_about(setup, Around())[1][0].systematic.root
    behind = model_about(setup, Around(values={"gain_0": 0.03}))[1][0].systematic.root
    ports = np.array([(p.i == 0) + (p.j == 0) for p in all_products()])
    close(behind, np.repeat(1.03 ** (ports / 2.0), 2)[:, None] * alone, 1e-12)


@pytest.mark.parametrize("kind", ["linear", "circular"])
def test_without_it_the_map_fails_and_with_it_the_errors_are_right(kind):
    """Two angles of the turntable, lmax 8, a sky of the prior, 1 % polarised up to ell = 10."""
    given = ["prior={model: isotropic}", "frequency_mhz=10", "observation.step_s=21600"]
    some = f"noise.polarisation={{{kind}: 0.01}}"
    given.append("observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}]")
    without, with_it = (small_scenario(*given, *more, lmax=8) for more in ([], [some]))
    setup = set_up(with_it)
    sky = np.asarray(setup.prior.sample(jax.random.key(101)))
    data = simulate(setup.under(replace(setup.sky, modes=sky)))
    found = (lb.infer(lb.build(one, data=data)) for one in (without, with_it))
    distances = [rms_of_directions(one, sky) for one in found]
    assert distances[0] > 100.0 and 0.7 < distances[1] < 1.4


def test_what_cannot_be_is_refused():
    beams = sampled_beams(MHZ, products=np.ones((16, 12 * 4**2)))
    setup = replace(setup_with(linear=0.01), beam_source=beams)
    why = "noise.polarisation: the beams: product beams, but this needs the E fields"
    refuse(why, model_about, setup, Around())
    refuse("less than.*equal to 1", small_scenario, "noise.polarisation.linear=1.5")
    refuse("greater than.*equal to 2", small_scenario, "noise.polarisation.lmax=1")
