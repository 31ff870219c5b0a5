"""Beams of one's own: sampled from known patterns, they give the known beams and visibilities."""

from dataclasses import replace
from functools import cache

import h5py
import healpy
import numpy as np
import pytest
import xarray as xr
from assertions import close, refuse
from astropy.io import fits
from reference import tangents, unit_vectors, vectors

import lusee_bayes as lb
from lusee_bayes.instrument.beams import monopoles, sampled
from lusee_bayes.instrument.beams.fields import HemisphereGrid, from_rings
from lusee_bayes.instrument.products import labels, to_real
from lusee_bayes.report.describe import describe
from lusee_bayes.testing import check_beam_source, small_scenario

FREQUENCY, LMAX, NSIDE = 25.0, 4, 16
THETA, PHI = healpy.pix2ang(NSIDE, np.arange(12 * NSIDE**2))
UP = np.pi / 2 > THETA
THETA_DEG, PHI_DEG = np.linspace(0.0, 90.0, 31), np.arange(0.0, 360.0, 6.0)
# cubic splines over steps h = 1 / NSIDE or 3 degrees err by 5/384 (h l)^4 of a pattern with l = 4
# (products of metres at 25 MHz, l = 2 k L). In the last step, which is extrapolated and a share h
# of all, it is 35 times that: (x - x_1) ... (x - x_4) there over its value in the middle of nodes
BETWEEN = 5 / 384 * (4 / NSIDE) ** 4
AT_HORIZON = 35 * BETWEEN
SPLINES = BETWEEN + AT_HORIZON / NSIDE


def on_pixels(antennas, frequency_mhz=FREQUENCY) -> dict[str, np.ndarray]:
    """Zero below the horizon, and on it: whatever a file has there is not used."""
    fields = np.zeros((2, 4, len(THETA)), dtype=complex)
    fields[:, :, UP] = antennas.towards(frequency_mhz, THETA[UP], PHI[UP])
    return {"e_theta": fields[0], "e_phi": fields[1]}


def on_grid(antennas, frequency_mhz=FREQUENCY) -> dict[str, np.ndarray]:
    theta, phi = np.radians(THETA_DEG), np.radians(PHI_DEG)
    e_theta, e_phi = antennas.towards(frequency_mhz, theta[:, None], phi[None])
    angles = {"theta_deg": THETA_DEG, "phi_deg": PHI_DEG}
    return {"e_theta": np.asarray(e_theta), "e_phi": np.asarray(e_phi), **angles}


def as_products(given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Beams of products in place of fields: (Et Ft* + Ep Fp*) / 2 written out."""
    theta, phi = given["e_theta"], given["e_phi"]
    pairs = (theta[:, None] * theta.conj() + phi[:, None] * phi.conj()) / 2
    angles = {name: one for name, one in given.items() if name.endswith("deg")}
    return {"products": to_real(pairs), **angles}


KINDS = {
    "pixels": on_pixels,
    "grid": on_grid,
    "products on pixels": lambda *args: as_products(on_pixels(*args)),
    "products on a grid": lambda *args: as_products(on_grid(*args)),
}


@cache
def embedded(kind, frequency_mhz=FREQUENCY):
    return KINDS[kind](monopoles.Monopoles(), frequency_mhz)


@pytest.mark.parametrize("kind", KINDS)
def test_short_dipoles_have_their_closed_form(kind):
    """Dipoles u at places r: B_ij = (u.v - (u.n)(v.n)) / 2 exp(i k n.(r_i - r_j)), no angles."""
    rng = np.random.default_rng(2)
    arms, places = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    k = monopoles.wavenumber(FREQUENCY)

    class Dipoles:
        def towards(self, _, theta, phi):
            along = [np.moveaxis(axis, -1, 0) for axis in tangents(theta, phi)]
            n = np.moveaxis(vectors(theta, phi), -1, 0)
            phase = np.exp(1j * k * np.tensordot(places, n, 1))
            return tuple(np.tensordot(arms, axis, 1) * phase for axis in along)

    made = sampled.sampled_beams(FREQUENCY, **KINDS[kind](Dipoles()), absolute=True)
    grid = HemisphereGrid.gauss_legendre(12, 20)
    n = unit_vectors(grid)
    along, phase = np.tensordot(arms, n, 1), np.exp(1j * k * np.tensordot(places, n, 1))
    expected = (arms @ arms.T)[:, :, None, None] - along[:, None] * along[None]
    expected = expected * phase[:, None] * phase[None].conj() / 2
    # baselines of 4 m have l = k b + 2 = 4 at most
    patterns = made.patterns(FREQUENCY, grid)
    assert np.abs(patterns - expected).max() < AT_HORIZON * np.abs(expected).max()
    # turned by an angle, the pattern at phi is the old one at phi - angle
    turned = replace(made, turntable_offset_deg=3 * 360.0 / grid.n_phi).patterns(FREQUENCY, grid)
    assert np.abs(turned - np.roll(patterns, 3, axis=-1)).max() < 1e-10 * np.abs(expected).max()


def test_rings_go_through_the_zenith():
    """A plane wave of l = 4, from the zenith to the last ring but some."""

    def wave(theta, phi):
        return np.exp(4j * (np.sin(theta) * np.cos(phi - 0.3) + 0.5 * np.cos(theta)))

    theta, phi = np.linspace(0.0, 1.4, 60), np.linspace(0.0, 6.0, 17)
    expected = wave(theta[:, None], phi[None])
    found = from_rings(np.where(UP, wave(THETA, PHI), np.nan), theta, phi)
    # orders +-3 in the first ring, at theta = sqrt(2/3) / NSIDE: J_3(x) = (x / 2)^3 / 6 each
    in_first_ring = 2 * (4 * np.sqrt(2 / 3) / NSIDE / 2) ** 3 / 6
    assert np.abs(found - expected).max() < BETWEEN + in_first_ring
    # a real function stays real
    real = from_rings(np.where(UP, wave(THETA, PHI).real, 0.0), theta, phi)
    np.testing.assert_allclose(real, found.real, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_sampled_beams_keep_the_contract(kind):
    source = replace(sampled.sampled_beams(FREQUENCY, **embedded(kind)), turntable_offset_deg=5.0)
    turned = replace(source, turntable_offset_deg=35.0)
    sizes = {"frequency_mhz": FREQUENCY, "lmax": LMAX, "quadrature": SPLINES}
    check_beam_source(source, turned, turned_deg=30.0, **sizes)


def modes_of(given, **more):
    return sampled.sampled_beams(FREQUENCY, **given, **more).beams(FREQUENCY, LMAX).modes


def test_the_scale_is_the_autos_or_the_files():
    given = dict(embedded("grid"))
    bright = given | {"e_theta": 3.0 * given["e_theta"], "e_phi": 3.0 * given["e_phi"]}
    autos = modes_of(bright)[[0, 7, 12, 15], 0] * np.sqrt(4 * np.pi)
    np.testing.assert_allclose(autos.mean(), 1.0, rtol=1e-12)
    one, nine = (modes_of(g, absolute=True) for g in (given, bright))
    np.testing.assert_allclose(nine, 9.0 * one, rtol=1e-12, atol=1e-12 * np.abs(nine).max())
    as_given = replace(sampled.sampled_beams(FREQUENCY, **bright), normalise=False)
    np.testing.assert_array_equal(as_given.beams(FREQUENCY, LMAX).modes, nine)


@pytest.mark.parametrize("suffix", ["nc", "fits"])
@pytest.mark.parametrize("kind", KINDS)
def test_files_come_back(tmp_path, kind, suffix):
    one, two = (embedded(kind, f) for f in (20.0, 30.0))
    angles = {name for name in one if name.endswith("deg")}
    arrays = {n: v if n in angles else np.stack([v, two[n]]) for n, v in one.items()}
    made = sampled.sampled_beams([20.0, 30.0], **arrays, absolute=True)
    path = sampled.write_sampled_beams(tmp_path / f"mine.{suffix}", made)
    again = sampled.read_beam(path)
    assert again.absolute
    np.testing.assert_array_equal(again.frequencies_mhz, [20.0, 30.0])
    # the grid's angles go through degrees and back: one rounding
    for f in (20.0, 24.0):
        ours, own = (np.asarray(b.beams(f, LMAX).modes) for b in (again, made))
        close(ours, own, 1e-13)
    refuse("20 to 30 MHz.* 31", again.beams, 31.0, LMAX)
    text = describe(path)
    assert "4 antennas" in text and "at 20, 30 MHz" in text


def test_a_scenario_takes_the_file(tmp_path):
    path = tmp_path / "mine.nc"
    sampled.write_sampled_beams(path, sampled.sampled_beams(FREQUENCY, **embedded("pixels")))
    scenario = small_scenario(f"beam.file={path}")
    assert scenario.beam.model == "sampled"
    assert (scenario.beam.source().n_ports, scenario.beam.label) == (4, "mine.nc")
    ours, own = (lb.build(s).setup.signal for s in (scenario, small_scenario()))
    assert np.abs(ours - own).max() < SPLINES * np.abs(own).max()
    given = f"beam={{model: sampled, file: {path}, rotations_deg: [0, 10]}}"
    refuse("rotations_deg belongs to model luseepy", small_scenario, given)


def test_product_beams_of_a_file_may_be_in_any_order(tmp_path):
    path = tmp_path / "mine.nc"
    made = sampled.sampled_beams(FREQUENCY, **embedded("products on pixels"))
    sampled.write_sampled_beams(path, made)
    order = np.random.default_rng(0).permutation(16)
    with xr.open_dataset(path, engine="h5netcdf") as file:
        shuffled = file.load().isel(product=order)
    shuffled.attrs["products"] = ", ".join(labels()[k] for k in order)
    shuffled.to_netcdf(path, engine="h5netcdf")
    np.testing.assert_array_equal(sampled.read_beam(path).products, made.products)
    shuffled.attrs["products"] = "00R, 01R"
    shuffled.to_netcdf(path, engine="h5netcdf")
    refuse(r"mine\.nc.*products.*00R, 01R.*names", sampled.read_beam, path)


@pytest.mark.parametrize("kind", ["pixels", "grid"])
def test_what_is_on_or_below_the_horizon_is_not_used(kind):
    given = embedded(kind)
    if kind == "grid":
        further = {"theta_deg": np.linspace(0.0, 180.0, 61)}
        for name in ("e_theta", "e_phi"):
            further[name] = np.full((4, 61, len(PHI_DEG)), np.nan + 0j)
            further[name][:, :30] = given[name][:, :30]
    else:
        further = {n: np.where(UP, given[n], np.nan) for n in ("e_theta", "e_phi")}
    np.testing.assert_array_equal(modes_of(given | further), modes_of(given))


def nan_at_the_zenith():
    given = dict(embedded("grid"))
    given["e_theta"] = given["e_theta"].copy()
    given["e_theta"][0, 0, 0] = np.nan
    return given


NO_BEAMS = [
    (lambda: {"e_theta": np.zeros((4, 48))}, "give e_theta and e_phi, or products"),
    (lambda: embedded("grid") | {"phi_deg": None}, "give both theta_deg and phi_deg"),
    (lambda: embedded("grid") | {"phi_deg": PHI_DEG + 1.0}, "expected 360 k / n"),
    (lambda: embedded("grid") | {"theta_deg": THETA_DEG / 2}, "to the horizon"),
    (lambda: embedded("grid") | {"theta_deg": THETA_DEG[::-1]}, "theta_deg does not increase"),
    (lambda: embedded("grid") | {"theta_deg": np.append(THETA_DEG[:-1] / 3, 90)}, "without a gap"),
    (lambda: {"products": np.ma.masked_less(np.zeros((16, 48)), 1.0)}, "NaN or infinity in"),
    (lambda: embedded("grid") | {"e_phi": np.zeros((3, 31, 60))}, "e_phi has shape"),
    (lambda: {"products": np.zeros((16, 50))}, "not the 12 NSIDE.2 pixels"),
    (lambda: {"products": np.zeros((5, 48))}, "5 products do not match"),
    (lambda: {"products": np.zeros((16, 48), dtype=complex)}, "type complex128, expected real"),
    (nan_at_the_zenith, "NaN or infinity in 1 of"),
]


@pytest.mark.parametrize(("given", "words"), NO_BEAMS)
def test_arrays_that_are_no_beams_are_refused(given, words):
    refuse(words, sampled.sampled_beams, FREQUENCY, **given())


def test_what_cannot_be_computed_is_refused():
    zero = sampled.sampled_beams(FREQUENCY, products=np.zeros((16, 12 * 4**2)))
    refuse("autos integrate to 0 sr", zero.beams, FREQUENCY, 2)
    refuse("needs the E fields", zero.fields, FREQUENCY, HemisphereGrid.for_lmax(2))
    two = np.zeros((2, 16, 48))
    refuse("frequency_mhz does not increase", sampled.sampled_beams, [20.0, 10.0], products=two)


@pytest.mark.parametrize("suffix", ["nc", "fits"])
def test_a_file_has_to_say_whether_its_scale_is_absolute(tmp_path, suffix):
    path, made = tmp_path / f"mine.{suffix}", sampled.sampled_beams(FREQUENCY, **embedded("grid"))
    sampled.write_sampled_beams(path, made)
    if suffix == "fits":
        fits.delval(path, "ABSOLUTE")
    else:
        with h5py.File(path, "r+") as file:
            del file.attrs["absolute"]
    refuse(str(path), sampled.read_beam, path)


# --- pyuvdata -------------------------------------------------------------------------------------


def uvbeam(coordinates: str):
    """The embedded antennas as a UVBeam: feeds are its ports, azimuth from East towards North."""
    pyuvdata = pytest.importorskip("pyuvdata")
    options = {"telescope_name": "LuSEE-Night", "data_normalization": "physical"}
    options |= {"freq_array": np.array([20e6, 30e6]), "mount_type": "fixed"}
    options |= {"feed_array": ["x", "y"], "feed_angle": np.array([np.pi / 2, 0.0])}
    options |= {"feed_name": "test", "model_name": "monopoles"}
    options |= {"feed_version": "1", "model_version": "1"}
    if coordinates == "healpix":
        options |= {"nside": NSIDE}
        given = [on_pixels(monopoles.Monopoles(), f) for f in (20.0, 30.0)]
    else:
        options |= {"axis1_array": np.radians(PHI_DEG), "axis2_array": np.radians(THETA_DEG)}
        given = [on_grid(monopoles.Monopoles(), f) for f in (20.0, 30.0)]
    # (vector: along phi, along theta; feed; frequency; directions)
    along = [[one[name][:2] for one in given] for name in ("e_phi", "e_theta")]
    options["data_array"] = np.stack([np.stack(one, axis=1) for one in along])
    return pyuvdata.UVBeam.new(**options)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("coordinates", ["az_za", "healpix"])
def test_a_uvbeam_is_its_fields(tmp_path, coordinates):
    beam = uvbeam(coordinates)
    expected = np.asarray(lb.monopole_beams(20.0, LMAX).modes)[[0, 1, 2, 7]]
    found = sampled.from_uvbeam(beam)
    assert found.n_ports == 2
    path = tmp_path / "uv.fits"
    beam.write_beamfits(str(path))
    scenario = small_scenario(f"beam.file={path}")
    for made in (found.beams(20.0, LMAX), scenario.beam.source().beams(20.0, LMAX)):
        assert np.abs(made.modes - expected).max() < SPLINES * np.abs(expected).max()
    conjugate = sampled.from_uvbeam(beam, conjugate=True).beams(20.0, LMAX).modes
    np.testing.assert_allclose(conjugate[2], -found.beams(20.0, LMAX).modes[2], atol=1e-15)
    beam.efield_to_power()
    refuse("give one of type efield", sampled.from_uvbeam, beam)


def test_without_pyuvdata_its_files_are_refused_with_what_to_install(tmp_path, monkeypatch):
    path, hdu = tmp_path / "uv.fits", fits.PrimaryHDU(np.zeros((2, 2)))
    hdu.header["NORMSTD"], hdu.header["FEEDLIST"] = "physical", "[x, y]"
    hdu.writeto(path)
    monkeypatch.setattr("lusee_bayes.instrument.beams.sampled.find_spec", lambda name: None)
    refuse(r"pip install '\.\[uvdata\]'", sampled.read_beam, path)
