"""The embedded sky: against ULSA itself, naive integration, physics and catalogues of sources."""

import dataclasses
import itertools

import h5py
import healpy as hp
import numpy as np
import pytest
from assertions import refuse
from scipy.integrate import quad
from tables import tables

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map, synthesis_matrix
from lusee_bayes.sky import galaxy
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, EXTENDED_OBJECTS

NSIDE = 64

# (l, b) in degrees: plane, inner Galaxy, anticentre, Vela shell, local bubbles, poles.
DIRECTIONS = [(0.5, 0.3), (0, 2), (30, 5), (45, 0), (80, -3), (180, 0), (60, -25), (200, 80)]


@pytest.fixture
def ulsa_map(test_data):
    """ULSA's own map in K at 1, 3 or 10 MHz."""
    folder = test_data / "ulsa"
    if not folder.is_dir():
        pytest.skip(f"no ULSA maps in {folder}")

    def read(frequency_mhz):
        with h5py.File(folder / f"exp{frequency_mhz:.1f}MHz_sky_map_with_absorption.hdf5") as file:
            return file["smooth_absorb"][:].astype(np.float64)

    return read


def embedded_sky(frequency_mhz: float) -> np.ndarray:
    """Diffuse sky with every source spread over the pixel that it falls in."""
    sky = galaxy.galaxy_map(frequency_mhz, NSIDE)
    for source in BRIGHT_SOURCES:
        pixel = hp.ang2pix(NSIDE, *source.galactic(), lonlat=True)
        sky[pixel] += source.kelvin_steradian(frequency_mhz) / hp.nside2pixarea(NSIDE)
    return sky


def emissivity(s, lon_deg, lat_deg, frequency_mhz):
    """Cong et al.'s formula, K/kpc, written out once more."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    radius = np.hypot(s * np.cos(lat) * np.sin(lon), 8.5 - s * np.cos(lat) * np.cos(lon))
    plane = 43.10 * ((radius + 0.1) / 3.41) ** 0.46 * np.exp(-radius / 3.41)
    height = np.exp(-((s * np.abs(np.sin(lat)) / 1.12) ** 1.23))
    return plane * height * (frequency_mhz / 408.0) ** -2.51


def n_squared(s, lon_deg, lat_deg):
    """<n_e^2> by asking of every point which region it lies in; cm^-6."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    x, y = s * np.cos(lat) * np.sin(lon), 8.5 - s * np.cos(lat) * np.cos(lon)
    z, radius = s * np.sin(lat), np.hypot(x, y)
    total = galaxy.thick_disc(radius) / np.cosh(np.minimum(np.abs(z) / 0.97, 90.0)) ** 4
    total += galaxy.thin_disc(radius) / np.cosh(np.minimum(np.abs(z) / 0.15, 90.0)) ** 4
    for region in reversed(galaxy.REGIONS):
        turn = np.radians(region.angle_deg)
        dx, dy, dz = (q - c for q, c in zip((x, y, z), region.centre_kpc, strict=True))
        a, b, c = region.semi_axes_kpc
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        inside = (along / a) ** 2 + (across / b) ** 2 + (dz / c) ** 2 <= 1.0
        total = np.where(inside, region.n_squared_cm6, total)
    return total


def slabs(lon_deg, lat_deg, frequency_mhz, steps=100_000):
    """Depth and emission in K of tiny steps along a line."""
    s, ds = (np.arange(steps) + 0.5) * 50.0 / steps, 50.0 / steps
    kappa = 1e3 * galaxy.absorption_per_emission_measure(frequency_mhz)
    depth = kappa * n_squared(s, lon_deg, lat_deg) * ds
    return depth, emissivity(s, lon_deg, lat_deg, frequency_mhz) * ds


def one_line(lon_deg, lat_deg, frequency_mhz, electrons=1.0):
    lon, lat = np.array([float(lon_deg)]), np.array([float(lat_deg)])
    slabs = galaxy.Slabs.towards(lon, lat)
    slabs = galaxy.Slabs(slabs.emitted, electrons * slabs.column)
    synchrotron, depth = slabs.synchrotron(frequency_mhz)
    row = 0 if lat_deg >= 0 else 1
    return synchrotron[row, 0], depth[row, 0]


def all_of_a_line(synchrotron, depth, frequency_mhz):
    return galaxy.brightness(np.array([synchrotron]), np.array([depth]), frequency_mhz)[0]


# --- against ULSA -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed, least", [(1, 0.7), (2, 0.7), (3, 0.7), (None, 0.5)])
def test_spectrum_at_10_mhz_is_ulsas(ulsa_map, seed, least):
    # A factor of two: loops and spurs add up to 80 % to the weakest odd multipoles. Where there is
    # no seed, with the sources: ULSA's smooth map has none, so that their white C_ell, up to 60 %
    # of it at ell = 30, comes on top.
    ours = embedded_sky(10.0) if seed is None else galaxy.galaxy_map(10.0, NSIDE, seed)
    ratio = (hp.anafast(ours, lmax=47) / hp.anafast(ulsa_map(10.0), lmax=47))[1:31]
    assert ratio.min() > least and ratio.max() < 2.0, np.round(ratio, 2)


@pytest.mark.parametrize("frequency_mhz, floor", [(1.0, 0.8), (3.0, 0.8), (10.0, 0.97)])
def test_mean_temperature_and_pattern_are_ulsas(ulsa_map, frequency_mhz, floor):
    # Asked for: 25 %. The electron column, all that differs, is tuned at 1 MHz only: 5 % is had.
    assert 0.95 < embedded_sky(frequency_mhz).mean() / ulsa_map(frequency_mhz).mean() < 1.05
    # Spectra forget phases. What we leave out shows below 10 MHz: Loop I's cap in the north at
    # 1 MHz, the arms at 3 MHz; each is about 15 % of the variance. So do our clouds and sources.
    ours, theirs = galaxy.galaxy_map(frequency_mhz, NSIDE), ulsa_map(frequency_mhz)
    assert np.corrcoef(ours, theirs)[0, 1] > floor


# --- the line-of-sight integral ---------------------------------------------------------------


@pytest.mark.parametrize("lon_deg, lat_deg", [*DIRECTIONS, (10, 90), (263.25, -9)])
def test_without_electrons_the_integral_is_quads(lon_deg, lat_deg):
    # Three Gauss points per panel leave 1e-6; 1e-4 within 0.3 kpc of the cusp at the centre.
    got, depth = one_line(lon_deg, lat_deg, 25.0, electrons=0.0)
    want = sum(
        quad(emissivity, a, b, args=(lon_deg, lat_deg, 25.0), epsabs=0.0, epsrel=1e-10)[0]
        for a, b in itertools.pairwise([0.0, 0.5, 2.0, 8.0, 8.5, 9.0, 17.0, 50.0])
    )
    assert got == pytest.approx(want, rel=1e-4 if lon_deg < 1.0 else 1e-6)
    assert depth == 0.0


@pytest.mark.parametrize("lon_deg, lat_deg", DIRECTIONS)
@pytest.mark.parametrize("frequency_mhz, tolerance", [(1.0, 1e-2), (10.0, 1e-3)])
def test_with_electrons_it_is_that_of_tiny_steps(lon_deg, lat_deg, frequency_mhz, tolerance):
    # Slabs of constant j and kappa: second order in the depth of one, which is 100 times less
    # at 10 MHz than at 1 MHz. Tolerances: see the measured errors of Slabs.
    slab, source = slabs(lon_deg, lat_deg, frequency_mhz)
    got, depth = one_line(lon_deg, lat_deg, frequency_mhz)
    assert got == pytest.approx(np.sum(source * np.exp(slab / 2 - np.cumsum(slab))), rel=tolerance)
    # A step misses the edge of a region by half its length, of a path of about 1 kpc.
    assert depth == pytest.approx(slab.sum(), rel=1e-3)


# --- the gas's own emission -------------------------------------------------------------------


def seen(emitted, column, frequency_mhz):
    """Brightness of one line through slabs: emission in K at 408 MHz, columns in cm^-6 pc."""
    columns = np.repeat(np.asarray(column)[:, None, None], 2, axis=1) / 1e3
    slabs = galaxy.Slabs(np.asarray(emitted)[:, None], columns)
    synchrotron, depth = slabs.synchrotron(frequency_mhz)
    return galaxy.brightness(synchrotron, depth, frequency_mhz)[0, 0]


@pytest.mark.parametrize("tau", [0.0, 1e-6, 0.1, 1.0, 3.0, 50.0])
def test_an_isothermal_slab_between_two_emitters_has_the_closed_form(tau):
    # In front of it all is seen, behind it exp(-tau): at tau = 50 it is a black body of T_e.
    frequency_mhz, front, behind = 25.0, 0.7, 3.0
    scale = (frequency_mhz / 408.0) ** -2.51
    column = tau / galaxy.absorption_per_emission_measure(frequency_mhz)
    farther = scale * behind + 1.2 * (frequency_mhz / 1e3) ** -2.58
    want = scale * front + np.exp(-tau) * farther + 8000.0 * (1.0 - np.exp(-tau))
    got = seen([front, 0.0, behind], [0.0, column, 0.0], frequency_mhz)
    assert got == pytest.approx(want, rel=1e-10)
    # cut into slabs it is the same slab
    parts = [0.1 * column, 0.6 * column, 0.3 * column]
    got = seen([front, 0, 0, 0, behind], [0, *parts, 0], frequency_mhz)
    assert got == pytest.approx(want, rel=1e-10)


@pytest.mark.parametrize("lon_deg, lat_deg", [*DIRECTIONS, (263.25, -9)])
def test_brightness_solves_the_equation_of_transfer(lon_deg, lat_deg):
    # dT/ds = j - kappa (T - T_e), marched from the background to the Sun by the trapezoidal rule,
    # whose error, (kappa ds)^2 tau / 12, is 2e-4 through the Vela shell at most. The tolerance is
    # the quadrature's at 10 MHz (Slabs).
    frequency_mhz = 25.0
    slab, source = slabs(lon_deg, lat_deg, frequency_mhz)
    temperature = 1.2 * (frequency_mhz / 1e3) ** -2.58
    for j, dtau in zip(source[::-1].tolist(), slab[::-1].tolist(), strict=True):
        temperature = (temperature * (1 - dtau / 2) + j + 8000.0 * dtau) / (1 + dtau / 2)
    got = all_of_a_line(*one_line(lon_deg, lat_deg, frequency_mhz), frequency_mhz)
    assert got == pytest.approx(temperature, rel=1e-3)


def test_absorption_coefficient_against_the_altenhoff_law():
    # tau = 8.235e-2 T^-1.35 nu^-2.1 EM (Altenhoff et al. 1960) is a fit of the same Gaunt factor
    # around 1 GHz, good to 5 % there (Mezger & Henderson 1967, ApJ 147, 471).
    for nu_ghz in (0.3, 1.0, 3.0):
        altenhoff = 8.235e-2 * galaxy.ELECTRON_TEMPERATURE_K**-1.35 * nu_ghz**-2.1
        ours = galaxy.absorption_per_emission_measure(1e3 * nu_ghz)
        assert ours == pytest.approx(altenhoff, rel=0.05)
    # Below, nu^-2 and the logarithm alone: ln(49.55) + 1.5 ln 8000 = 17.383 at 1 MHz, ln 10 less
    # at 10 MHz.
    ratio = galaxy.absorption_per_emission_measure(1.0)
    ratio /= galaxy.absorption_per_emission_measure(10.0)
    assert ratio == pytest.approx(100.0 * 17.383 / 15.081, rel=1e-3)


# --- the map ----------------------------------------------------------------------------------


def test_pixel_order_is_galactic_ring():
    # The Vela shell and the superbubble tell l from -l and b from -b.
    frequency_mhz = 5.0
    sky = galaxy.galaxy_map(frequency_mhz, NSIDE)
    for direction in [(263.25, -9.0), (96.75, -9.0), (263.25, 9.0), (60.0, 30.0), (20.0, -70.0)]:
        pixel = hp.ang2pix(NSIDE, *direction, lonlat=True)
        lon, lat = hp.pix2ang(NSIDE, pixel, lonlat=True)
        galactic, depth = one_line(lon, lat, frequency_mhz)
        want = all_of_a_line(galactic, depth, frequency_mhz)
        assert sky[pixel] == pytest.approx(want, abs=0.25 * galactic)  # 5 sigma of the texture
    assert sky[hp.ang2pix(NSIDE, 263.25, -9.0, lonlat=True)] < 0.1 * np.median(sky)


def test_seed_fixes_the_random_component_at_all_frequencies():
    first = galaxy.galaxy_map(25.0, 32, seed=7)
    np.testing.assert_array_equal(first, galaxy.galaxy_map(25.0, 32, seed=7))
    assert np.abs(first / galaxy.galaxy_map(25.0, 32, seed=8) - 1.0).max() > 0.01

    def texture(frequency_mhz, seed):
        a, b = (galaxy.galaxy_map(frequency_mhz, 32, s) for s in (seed, seed + 1))
        return np.log(a / b)

    # The same pattern, diluted by the background: 25 and 45 MHz differ by its 7 % share of T.
    assert np.corrcoef(texture(25.0, 1), texture(45.0, 1))[0, 1] > 0.99


def test_random_component_has_the_stated_rms_and_large_scales_at_every_nside():
    # One map's rms scatters by 0.12 of itself (few modes rule a spectrum ell^-2.7): 4 sigma.
    rms = [np.std(galaxy._fluctuations(64, seed)) for seed in range(20)]
    assert np.mean(rms) == pytest.approx(galaxy.FLUCTUATION_RMS, rel=4.0 * 0.12 / np.sqrt(20.0))
    maps = (galaxy._fluctuations(nside, 3) for nside in (16, 64))
    coarse, fine = (hp.map2alm(one, lmax=8, iter=10) for one in maps)
    # Pixel quadrature at the band limit of nside 16 costs 1e-4, against 2e-2 of another draw.
    np.testing.assert_allclose(coarse, fine, atol=2e-4)
    assert np.std(fine) > 5e-3


def test_loops_clouds_and_faint_sources_are_the_same_at_every_nside():
    coarse, fine = (galaxy.Structures.of(nside, 4) for nside in (16, 64))
    # the texture's small scales, 2 % of rms, are in the finer map alone
    assert np.std(hp.ud_grade(fine.emission, 16) / coarse.emission) < 0.03
    assert fine.emission.mean() == pytest.approx(1.0) and fine.emission.std() > 0.06
    away = galaxy._seen_from(EXTENDED_OBJECTS[0], np.array([280.5, 280.5]), np.array([-32.9, 7.1]))
    np.testing.assert_allclose(away[0], np.radians([0.0, 40.0]), atol=1e-9)
    assert coarse.flux_jy.sum() == pytest.approx(fine.flux_jy.sum())
    # N(> S) ~ S^-1.5, but for those that share a pixel: 2300 in 49152
    above = (fine.flux_jy > 20.0).sum() / (fine.flux_jy > 10.0).sum()
    assert above == pytest.approx(2.0**-1.5, abs=0.05)


@pytest.mark.parametrize("frequency_mhz", [3.0, 50.0])  # opaque, and nearly transparent
def test_clouds_absorb_what_they_cover(frequency_mhz):
    """A dense cloud leaves the share that is not covered, and adds its own 8000 K."""
    drawn = galaxy.Structures.of(NSIDE, 4)
    k, at = np.unravel_index(np.argmax(drawn.clouds), drawn.clouds.shape)
    assert np.delete(drawn.clouds, k, axis=0)[:, at].max() < 1.0
    depth = galaxy.absorption_per_emission_measure(frequency_mhz) * drawn.clouds[k, at]
    synchrotron, gas = one_line(*hp.pix2ang(NSIDE, at, lonlat=True), frequency_mhz)
    bare = all_of_a_line(synchrotron * drawn.emission[at], gas, frequency_mhz)
    want = bare + drawn.covered[k] * (1.0 - np.exp(-depth)) * (8000.0 - bare)
    assert galaxy.galaxy_map(frequency_mhz, NSIDE, 4)[at] == pytest.approx(want, rel=0.02)


@pytest.mark.parametrize("given", [(0.5,), (51.0,), (float("nan"),), (10.0, 48), (10.0, 64, -1)])
def test_bad_input_is_named(given):
    refuse(f"is {given[-1]}, expected .*; (use|give) ", galaxy.galaxy_map, *given)


SIZED = {
    "sky": lambda n: lb.galaxy_sky(25.0, lmax=n),
    "map": lambda n: galaxy.galaxy_map(25.0, nside=n),
    "beams": lambda n: lb.monopole_beams(25.0, n),
    "synthesis": lambda n: modes_to_map(np.zeros(16), n),
}


@pytest.mark.parametrize("value", [-3, 10**12])
@pytest.mark.parametrize("call", SIZED.values(), ids=list(SIZED))
def test_sizes_that_would_end_the_process_are_refused(call, value):
    """healpy's C code aborts for some of them."""
    refuse("expected a whole number", call, value)


SOURCES = {source.name: source for source in BRIGHT_SOURCES}


@pytest.mark.parametrize("bad", [0.0, -3.0, float("nan")])
def test_frequencies_are_positive(bad):
    refuse("must be positive", SOURCES["Cyg A"].flux_jy, bad)


POSITIONS = tables(__file__)["positions"]


@pytest.mark.parametrize("name, lon_deg, lat_deg", POSITIONS)
def test_galactic_positions(name, lon_deg, lat_deg):
    # Catalogues round to 0.1 degree (Green) or 0.01.
    assert SOURCES[name].galactic() == pytest.approx((lon_deg, lat_deg), abs=0.06)


FLUXES = [
    # Baars et al. 1977, table 4, Cyg A: their errors are 5 to 10 %; 15 % at the turnover.
    ("Cyg A", 38.0, 25500.0, 0.10),
    ("Cyg A", 25.0, 31500.0, 0.15),
    ("Cyg A", 20.0, 27000.0, 0.15),
    ("Cyg A", 10.05, 13500.0, 0.10),
    # Baars et al. 1977, table 5, at 500 MHz: the two scales differ by less than 10 %.
    ("Vir A", 500.0, 10 ** (5.023 - 0.856 * np.log10(500.0)), 0.10),
    ("Her A", 500.0, 10 ** (4.963 - 1.052 * np.log10(500.0)), 0.10),
    ("Hyd A", 500.0, 10 ** (4.497 - 0.910 * np.log10(500.0)), 0.10),
    # Cas A, log S = 5.745 - 0.770 log nu in 1980, fading by 0.65 % a year (Reichart &
    # Stephens 2000, ApJ 537, 904: 0.6 to 0.7 % at all frequencies) to 2016.
    ("Cas A", 500.0, 10 ** (5.745 - 0.770 * np.log10(500.0)) * 0.9935**36, 0.10),
    # and 0.66 of Bridle's 28 kJy of 1965 at 10.05 MHz.
    ("Cas A", 10.05, 18500.0, 0.10),
    ("Cen A", 408.0, 2740.0, 1e-3),
]


@pytest.mark.parametrize("name, frequency_mhz, flux_jy, tolerance", FLUXES)
def test_published_fluxes(name, frequency_mhz, flux_jy, tolerance):
    assert SOURCES[name].flux_jy(frequency_mhz) == pytest.approx(flux_jy, rel=tolerance)


@pytest.mark.parametrize("source", BRIGHT_SOURCES, ids=lambda source: source.name)
def test_spectrum_is_continuous_positive_and_turns_over(source):
    edge = source.valid_from_mhz
    # 1e-6 in frequency changes a flux of index about -1 by as much.
    assert source.flux_jy(edge * (1 - 1e-6)) == pytest.approx(source.flux_jy(edge), rel=5e-6)
    frequency_mhz = np.linspace(1.0, 50.0, 491)
    flux = source.flux_jy(frequency_mhz)
    assert flux.shape == frequency_mhz.shape and np.all(flux > 0.0)
    # nu^alpha exp(-(nu/nu_t)^-2.1) peaks at nu_t (2.1 / |alpha|)^(1/2.1), 1.2 to 2.7 nu_t here.
    assert 1.2 < frequency_mhz[np.argmax(flux)] / source.turnover_mhz < 2.7


@pytest.mark.parametrize("name", ["Vir A", "Tau A", "Cen A", "For A", "Her A", "Hyd A", "Pic A"])
def test_unmeasured_turnovers_are_those_of_the_embedded_electrons(name):
    # Rounded to 0.1 MHz of 1.2: 4 % in nu_t, 9 % in depth; the nu^-2.1 law adds up to 7 %.
    source = SOURCES[name]
    _, depth = one_line(*source.galactic(), source.turnover_mhz)
    assert depth == pytest.approx(1.0, rel=0.16)


def test_kelvin_steradian_is_the_rayleigh_jeans_law():
    # A disc of 1 K and 0.01 sr at 30 MHz: S = 2 k T Omega / lambda^2, lambda = 9.993 m.
    flux_jy = 2.0 * 1.380649e-23 * 0.01 / (299792458.0 / 30e6) ** 2 / 1e-26
    law = {"log_flux": (np.log10(flux_jy),), "valid_from_mhz": 1.0}
    source = dataclasses.replace(SOURCES["Cyg A"], **law)
    assert source.kelvin_steradian(30.0) == pytest.approx(0.01, rel=1e-12)
    # Cyg A at 38 MHz, 25.5 kJy: lambda = 7.889 m gives 574.8 K sr; its flux is held to 1 %.
    assert SOURCES["Cyg A"].kelvin_steradian(38.0) == pytest.approx(574.8, rel=0.01)


@pytest.mark.parametrize("one", [o for o in EXTENDED_OBJECTS if o.width_deg > 6.5])
def test_an_extended_object_is_its_profile_about_its_centre(one):
    """Width w: what is above lmax = 95 is exp(-(95 w / 2.355)^2 / 2), 1e-5 at most."""
    rng = np.random.default_rng(3)
    theta, phi = np.arccos(rng.uniform(-1.0, 1.0, 200)), rng.uniform(0.0, 2.0 * np.pi, 200)
    centre = hp.ang2vec(one.l_deg, one.b_deg, lonlat=True)
    away = np.degrees(np.arccos(hp.ang2vec(theta, phi) @ centre)) - one.radius_deg
    expected = np.exp(-0.5 * (away / (one.width_deg / np.sqrt(8.0 * np.log(2.0)))) ** 2)
    found = synthesis_matrix(theta, phi, 95) @ one.modes(95)
    np.testing.assert_allclose(found, expected, atol=1e-4)
