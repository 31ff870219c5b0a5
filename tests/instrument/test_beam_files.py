"""Beams from luseepy's files, against what luseepy itself made of them, and synthetic files."""

import json
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
import xarray as xr
from assertions import off, refuse, within
from astropy.io import fits
from astropy.time import Time
from commands import run, sets
from fits_files import write_images
from reference import hemisphere, real_harmonics

import lusee_bayes as lb
from lusee_bayes.experiment.experiment import program_pieces
from lusee_bayes.experiment.model import moved, set_up, true_signal, true_values
from lusee_bayes.experiment.unknowns import flux_table
from lusee_bayes.instrument.beams.fields import HemisphereGrid, ProductBeams, product_modes
from lusee_bayes.instrument.beams.luseepy_files import FIELD_NAMES, parts_of
from lusee_bayes.instrument.beams.monopoles import Monopoles, Regolith
from lusee_bayes.instrument.beams.sampled import read_beam
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.waterfalls import read_waterfall
from lusee_bayes.systematics.beam import beam_rms_difference, difference_of_beams
from lusee_bayes.testing import small_scenario

LMAX = 47


# --- luseepy's own waterfall --------------------------------------------------------------------


@pytest.fixture(scope="module")
def luseepy(test_data):
    """(beam, waterfall by frequency, sky by frequency, pointing)."""
    folder = test_data / "luseepy"
    with fits.open(folder / "waterfall_exact_engine.fits") as hdus:
        data, frequencies = hdus["data"].data.astype(float), hdus["freq"].data
    times = Time("2025-02-01 00:00:00", scale="utc") + 7200.0 * np.arange(len(data)) * u.s
    observation = lb.Observation(182.258, -23.814, times, np.zeros(len(data), int), (0.0,), 7200.0)
    return (
        read_beam(folder / "synthetic_monopole_beam.fits"),
        {f: data[:, :, k].T for k, f in enumerate(frequencies)},
        {f: lb.sky_from_file(folder / "sky_alm.npz", f, LMAX).modes for f in frequencies},
        Pointing.of(observation, LMAX, order=6),
    )


def visibilities(luseepy, frequency, grid=None, **options) -> np.ndarray:
    beam, _, sky, pointing = luseepy
    beam = replace(beam, **options)
    if grid is None:
        beams = beam.beams(frequency, LMAX)
    else:
        modes = product_modes(beam.fields(frequency, grid), LMAX, normalise=False)
        beams = ProductBeams(modes, frequency)
    return np.asarray(lb.CouplingMatrix.build(beams, pointing) @ sky[frequency]).reshape(16, -1)


@pytest.mark.parametrize("frequency", [10.0, 25.0])
def test_all_products_of_luseepys_waterfall(luseepy, frequency):
    """With luseepy's rule both are one sum, in another order; 1e-10 of the peak is asked for."""
    got = visibilities(luseepy, frequency, luseepy_quadrature=True)
    assert off(got, luseepy[1][frequency]) < 1e-11


def test_the_waterfall_of_luseepys_default_engine(luseepy, test_data):
    """It turns the sky about the first sample's axis, and patterns in single precision."""
    with fits.open(test_data / "luseepy" / "waterfall_fixed_axis_engine.fits") as hdus:
        expected = hdus["data"].data[:, :, list(hdus["freq"].data).index(25.0)].T
    beam, _, sky, _ = luseepy
    observation = read_waterfall(test_data / "luseepy" / "waterfall_fixed_axis_engine.fits")
    observation = replace(observation.observation, fixed_axis=True)
    beams = replace(beam, luseepy_quadrature=True).beams(25.0, LMAX)
    seen = lb.CouplingMatrix.observe(beams, observation) @ sky[25.0]
    assert off(np.asarray(seen).reshape(16, -1), expected) < 1e-7


@pytest.mark.long
def test_what_the_rectangle_rule_costs(luseepy):
    """h^2 / 12 times the slopes of the beam at zenith and horizon (Euler and Maclaurin): 1.6e-4 of
    the peak for steps of 1 degree, a quarter of it for half a degree.

    Between nodes that integrate across the cut nothing changes when their number doubles.
    """
    beam, ours = luseepy[0], visibilities(luseepy, 25.0)
    cost = off(luseepy[1][25.0], ours)
    assert 1e-4 < cost < 2e-4
    more = HemisphereGrid.gauss_legendre(4 * len(beam.theta), 360)
    assert off(visibilities(luseepy, 25.0, grid=more), ours) < 1e-8
    theta = np.linspace(0.0, np.pi / 2, 2 * len(beam.theta) - 1)
    finer = HemisphereGrid(theta, np.sin(theta) * theta[1], beam.n_phi)
    assert off(visibilities(luseepy, 25.0, grid=finer), ours) == pytest.approx(cost / 4, rel=0.1)


def test_the_embedded_antennas_agree_with_the_file_in_shape(luseepy):
    """Both are a 3 m arm, 75 degrees from the zenith, 2 m over ground; that of the file has one
    layer of permittivity 3.7."""
    ours = lb.monopole_beams(10.0, 12, Monopoles(Regolith(3.7, 3.7, 0.01))).modes
    # ports of luseepy: North, West, South, East; ours: North, East, South, West
    beam = replace(luseepy[0], taper=False, rotations_deg=(0.0, -90.0, 180.0, 90.0))
    a, b = np.asarray(ours), np.asarray(beam.beams(10.0, 12).modes)
    assert (a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()) > 0.99


# --- synthetic files --------------------------------------------------------------------------


def write(path, *, change=None, header=None):
    frequencies = (10.0, 20.0, 30.0, 40.0, 50.0)
    theta, phi = np.radians(np.linspace(0, 90, 46)), np.radians(np.linspace(0, 360, 61))
    fields = [point_pattern(theta[:, None], phi[None], f) for f in frequencies]
    e_theta, e_phi = np.moveaxis(fields, 1, 0)
    images = {
        "Etheta_real": e_theta.real,
        "Etheta_imag": e_theta.imag,
        "EPhi_real": e_phi.real,
        "EPhi_imag": e_phi.imag,
        "gain_conv": 100.0 / np.array(frequencies),
        "freq": np.array(frequencies),
    }
    if change is not None:
        change(images)
    head = {"THETA_MIN": 0.0, "THETA_MAX": 90.0, "THETA_N": 46}
    head |= {"PHI_MIN": 0.0, "PHI_MAX": 360.0, "PHI_N": 61} | (header or {})
    return write_images(path, images, head)


def test_between_frequencies_and_directions(tmp_path):
    """Cubic splines over steps of 10 MHz and 2 degrees of a pattern known everywhere."""
    beam = replace(read_beam(write(tmp_path / "beam.fits")), interpolation="spline")
    assert beam.n_phi == 60
    arms = replace(beam, taper=False, rotations_deg=(0.0, 33.0))
    grid = HemisphereGrid.gauss_legendre(92, 60)
    fields, theta = arms.fields(27.0, grid), grid.theta[:, None]
    scale = np.sqrt(2 * (100.0 / 27.0) / (4 * np.pi))
    for port, angle in enumerate((0.0, 33.0)):
        e_theta, e_phi = point_pattern(theta, grid.phi - np.radians(angle), 27.0)
        # (h f)^4 / 100 of a phase of f / 20, and of 100 / f
        within(fields.e_theta[port], scale * e_theta, 3e-2)
        within(fields.e_phi[port], scale * e_phi, 3e-2)
    # (2 degrees)^4 / 384 of the fourth derivative, a few times that at the ends
    exact = arms.fields(30.0, grid)
    e_theta, e_phi = point_pattern(theta, grid.phi - np.radians(33.0), 30.0)
    scale = np.sqrt(2 * (100.0 / 30.0) / (4 * np.pi))
    within(exact.e_theta[1], scale * e_theta, 5e-6)
    within(exact.e_phi[1], scale * e_phi, 5e-6)
    # quarter turns by moving columns, or by the Fourier sum on another number of azimuths
    few = beam.fields(30.0, grid)
    many = beam.fields(30.0, HemisphereGrid(grid.theta, grid.weights, 120))
    within(many.e_theta[:, :, ::2], few.e_theta, 1e-13)


def test_between_frequencies_as_luseepy_does(tmp_path):
    """Straight lines between the integrals of products, and between gains: summed by hand.

    The exact grid's nodes are between the file's directions, where splines are good to 5e-6.
    """
    beam, angles = read_beam(write(tmp_path / "beam.fits")), (0.0, 33.0)
    theta, phi, solid_angle = hemisphere(40, 90)
    harmonics, crossed = real_harmonics(theta, phi, 4) * solid_angle[:, None], {}
    for f in (20.0, 30.0):
        fields = [point_pattern(theta, phi - np.radians(angle), f) for angle in angles]
        arms = [np.array([e.ravel() for e in field]) for field in fields]
        first, second = ((np.abs(arm) ** 2).sum(0) for arm in arms)
        cross = (arms[0] * arms[1].conj()).sum(0)
        crossed[f] = np.array([first, cross.real, cross.imag, second]) @ harmonics
    gain = 0.3 * 100.0 / 20.0 + 0.7 * 100.0 / 30.0
    expected = gain / (4 * np.pi) * (0.3 * crossed[20.0] + 0.7 * crossed[30.0])
    beam = replace(beam, taper=False, rotations_deg=angles, moon_k=2.0)
    got, largest = beam.beams(27.0, 4).modes, np.abs(expected).max()
    within(got, expected, 1e-5 * largest)
    splined = replace(beam, interpolation="spline").beams(27.0, 4).modes
    assert np.abs(splined - expected).max() > 1e-2 * largest
    # the ground is what the sky leaves
    emitted = beam.background(27.0)
    left = np.array([1.0, 0.0, 0.0, 1.0]) - np.sqrt(4 * np.pi) * expected[:, 0]
    within(emitted, 2.0 * left, 1e-4 * np.abs(left).max())


def point_pattern(theta, phi, f):
    """:func:`pattern` in single directions."""
    e_theta = np.cos(theta) * np.cos(phi - 0.3) + 0.2 * np.sin(2 * theta)
    phase = np.exp(1j * f / 20 * np.cos(theta))
    return e_theta * phase, -np.sin(phi - 0.3) * (1 + 0.1j * np.sin(theta))


UNUSABLE = [
    ({"change": lambda i: i.update(EPhi_imag=i["EPhi_imag"][:, :-1])}, "EPhi_imag has shape"),
    ({"change": lambda i: i.update(freq=i["freq"][::-1].copy())}, "freq does not increase"),
    ({"change": lambda i: i.update(gain_conv=i["gain_conv"][:-1])}, "gain_conv has shape"),
    ({"header": {"THETA_MAX": 180.0}}, "THETA_MAX is 180.0, expected a number from 90 to 90"),
    ({"header": {"TIMECONV": "e-iwt"}}, "TIMECONV"),
    ({"change": lambda images: images["freq"].__imul__(1e6)}, "is this Hz"),
]


@pytest.mark.parametrize(("options", "message"), UNUSABLE)
def test_files_that_cannot_be_used(tmp_path, options, message):
    refuse(message, read_beam, write(tmp_path / "beam.fits", **options))


def test_missing_and_other_files(tmp_path):
    refuse(r"no beam file.*beam\.file", read_beam, tmp_path / "none.fits")
    path = tmp_path / "beam.fits"
    path.write_text("no FITS at all")
    refuse("scalar beam.*not a FITS file$", read_beam, path)


# --- in a scenario ----------------------------------------------------------------------------


def test_a_scenario_with_a_file(tmp_path):
    path = write(tmp_path / "beam.fits")
    setup = set_up(small_scenario(f"beam.file={path}", "beam.turntable_offset_deg=7"))
    expected = replace(read_beam(path), rotations_deg=(7.0, 97.0, 187.0, 277.0)).beams(25.0, 6)
    np.testing.assert_array_equal(setup.beams.modes, expected.modes)


def test_a_second_file_as_the_true_beams(tmp_path):
    def brighter(images):
        for name in parts_of(*FIELD_NAMES):
            images[name] = 1.01 * images[name]

    path, other = write(tmp_path / "a.fits"), write(tmp_path / "b.fits", change=brighter)
    setup = set_up(small_scenario(f"beam.file={path}", f"noise.beam.file={other}"))
    assert beam_rms_difference(setup) == pytest.approx(1.01**2 - 1, rel=1e-9)
    direction = difference_of_beams(setup.scenario.noise.beam, setup, {})
    within(direction, (1.01**2 - 1) * np.asarray(setup.beams.modes), 1e-12)
    signal = np.asarray(true_signal(setup, true_values(setup)))
    modelled = np.asarray(setup.signal)
    within(signal, 1.01**2 * modelled, 1e-9 * modelled.max())
    # against the embedded antennas, and a shift in frequency of a file
    setup = set_up(small_scenario(f"noise.beam.file={other}"))
    true = moved(setup, true_values(setup)).beams
    np.testing.assert_array_equal(true.modes, read_beam(other).beams(25.0, 6).modes)
    setup = set_up(small_scenario(f"beam.file={path}", "noise.beam.shift_mhz=5"))
    true = moved(setup, true_values(setup)).beams
    np.testing.assert_array_equal(true.modes, read_beam(path).beams(30.0, 6).modes)


NOT_OF_A_FILE = [
    (["beam.length_m=2"], "length_m belongs to model monopole, not to luseepy"),
    (["noise.beam={parameters: {length_m: 0.1}}"], "which beam.file replaces"),
    (["noise.beam={shift_mhz: 1, file: some.fits}"], "give either shift_mhz, file or param"),
]


@pytest.mark.parametrize(("overrides", "message"), NOT_OF_A_FILE)
def test_what_a_file_does_not_have(overrides, message):
    refuse(message, lb.load_scenario, "fiducial", ["beam.file=some.fits", *overrides])


POINTED = "noise.pointing={turntable_deg: 0.5}"


def test_sources_are_seen_by_beams_of_files(tmp_path):
    """Fluxes are found, the turntable unknown; where it is sampled, it is refused."""
    seen = "sources.list=[{name: Cas A}, {name: Sun, flux_jy: 2e4}]"
    own = f"beam.file={write(tmp_path / 'beam.fits')}", seen, "noise.radiometer.factor=100"
    experiment = lb.build(small_scenario(*own, POINTED, lmax=3, cycles=0.5))
    found = flux_table(experiment, lb.infer(experiment))
    assert ((found["flux_jy"] - found["true_jy"]).abs() < 4.0 * found["std_jy"]).all()
    assert (found["std_jy"] < 0.2 * found["prior_std_jy"]).all()
    sampled = POINTED.replace("0.5", "0.5, treatment: sampled")
    refuse("cannot be sampled with clock and pointing", lb.build, small_scenario(*own, sampled))


def test_the_program_of_the_instrument_needs_the_embedded_antennas(tmp_path):
    experiment = lb.build(small_scenario(f"beam.file={write(tmp_path / 'beam.fits')}"))
    refuse("remove beam.file", program_pieces(experiment)["instrument"])


@pytest.mark.long
def test_two_ports_from_a_file_make_a_map(tmp_path):
    path = write(tmp_path / "beam.fits")
    given = ["lmax=6", "observation.runs.0.cycles=0.02", f"beam.file={path}"]
    arguments = sets(*given, "beam.rotations_deg=[0,90]")
    assert run("map", "fiducial", *arguments, "-o", tmp_path / "map", "--quiet") == 0
    with xr.open_datatree(tmp_path / "map" / "diagnostics.nc", engine="h5netcdf") as found:
        assert json.loads(found["25"].attrs["labels"]) == ["00R", "01R", "01I", "11R"]
