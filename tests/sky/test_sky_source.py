"""Every source of skies keeps the same contract; files of every layout are scaled alike.

And each layout by itself: maps, cubes of maps, coefficients.
"""

import h5py
import healpy
import numpy as np
import pytest
from assertions import refuse
from astropy.io import fits
from made_skies import SmoothSky, SpottySky

import lusee_bayes as lb
from lusee_bayes.core.harmonics import from_healpy, modes_to_map, synthesis_matrix, to_healpy
from lusee_bayes.experiment.sky_sections import FileSkySection, GalaxySection
from lusee_bayes.report.describe import describe
from lusee_bayes.results.finished_runs import write_cubes
from lusee_bayes.sky import sky_source as ss
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES
from lusee_bayes.testing import assert_refused, check_sky_source

NSIDE, LMAX = 16, 8
# healpy's iterated quadrature of a map of NSIDE 16 without power above ell = 4, rms
BAND_LIMITED = 1e-9


@pytest.fixture(scope="module")
def modes():
    """A sky near 1e5 K without power above ell = 4, so that no map of it aliases."""
    modes = np.zeros((LMAX + 1) ** 2)
    modes[:25] = 1e3 * np.random.default_rng(4).standard_normal(25)
    modes[0] = 1e5
    return modes


def write_fits(path, pixels, unit="K", **keywords):
    keywords = {"coord": "G"} | keywords
    healpy.write_map(path, pixels, dtype=np.float64, column_units=unit, **keywords)


def write_hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        file.update(arrays)


def write_cube(path, maps, start=1, end=None, step=1):
    """The cards of ULSA_32_ddi_smooth.fits: integers, two of them beyond eight letters."""
    hdu = fits.PrimaryHDU(maps)
    hdu.header["HIERARCH FREQ_START"] = start
    hdu.header["FREQ_END"] = start + step * (len(maps) - 1) if end is None else end
    hdu.header["HIERARCH FREQ_STEP"] = step
    hdu.header["TYPE"] = "ulsa"
    hdu.writeto(path)
    return path


def cube(path, modes):
    """The same sky at 24, 25 and 26 MHz."""
    write_cube(path, np.tile(modes_to_map(modes, NSIDE), (3, 1)), start=24)


def npz_alms(path, modes):
    np.savez(path, alm=np.tile(to_healpy(modes), (3, 1)), freq=[24.0, 25.0, 26.0])


# name of the file, who writes it, who reads it, and whether it says its frequencies
LAYOUTS = [
    ("map.fits", lambda path, m: write_fits(path, modes_to_map(m, NSIDE)), ss.SkyMap, False),
    ("map.hdf5", lambda path, m: write_hdf5(path, other=modes_to_map(m, NSIDE)), ss.SkyMap, False),
    ("cube.fits", cube, ss.SkyCube, True),
    ("alm.fits", lambda path, m: ss.write_alms(path, m, {}), ss.SkyAlms, False),
    ("alm.npz", npz_alms, ss.SkyAlms, True),
]
of_every_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout[0])


def written(layout, folder, modes):
    name, write, _, _ = layout
    write(folder / name, modes)
    return folder / name, "other" if name.endswith("hdf5") else None


@of_every_layout
def test_files_keep_the_contract(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    source = FileSkySection(file=str(path), dataset=dataset)
    missing = {"missing_mhz": 10.0 if layout[3] else None, "missing_lmax": 3 * NSIDE}
    sizes = {"frequency_mhz": 25.0, "lmax": LMAX, "slice_rtol": BAND_LIMITED}
    check_sky_source(source, **sizes, **missing)
    assert source.at(25.0, LMAX).name == path.name
    np.testing.assert_allclose(source.at(25.0, LMAX).modes, modes, rtol=0, atol=1e-9 * modes[0])


@of_every_layout
def test_files_are_scaled_from_their_frequency(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    there = lb.sky_from_file(path, 25.0, LMAX, dataset=dataset)
    made_for = {"dataset": dataset, "file_frequency_mhz": 25.0}
    scaled = lb.sky_from_file(path, 10.0, LMAX, **made_for, spectral_index=-2.1)
    assert scaled.frequency_mhz == 10.0
    np.testing.assert_allclose(scaled.modes, np.asarray(there.modes) * 0.4**-2.1, rtol=1e-13)
    # the paper's index by default
    again = lb.sky_from_file(path, 10.0, LMAX, **made_for)
    np.testing.assert_allclose(again.modes, np.asarray(there.modes) * 0.4**-2.5, rtol=1e-13)


@of_every_layout
def test_exactly_one_reader_reads_a_file(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    found = next(reader for reader in ss.SKY_READERS if reader.recognises(path))
    assert found is layout[2]
    assert isinstance(ss.read_sky_file(path, dataset), found)
    assert all(line.strip() for line in ss.read_sky_file(path, dataset).description())


def test_the_galaxy_keeps_the_contract():
    # the Galaxy's map of NSIDE 64 has power above lmax: up to 2.1e-5 between 8 and 48
    source = GalaxySection()
    check_sky_source(source, frequency_mhz=25.0, lmax=16, slice_rtol=1e-4, missing_mhz=60.0)
    assert_refused(lambda: source.at(0.5, 16))


@pytest.mark.parametrize("kind", [SmoothSky, SpottySky])
def test_the_test_skies_keep_the_contract(kind):
    # the background's plane has power above lmax, 6e-6 between 8 and 191
    check_sky_source(kind(), frequency_mhz=10.0, lmax=16, slice_rtol=1e-4)
    assert kind().at(20.0, 8).mean_temperature == pytest.approx(3e5 * 2**-2.5, rel=0.05)
    first, second = (np.asarray(kind(seed).at(10.0, 8).modes) for seed in (1, 2))
    assert np.abs(first - second).max() > 1e-3 * np.abs(first).max()


def test_a_file_is_there_and_its_frequency_positive():
    given = lb.sky_from_file, "nowhere.fits", 25.0, LMAX
    for frequency in (0.0, -3.0, np.nan):
        refuse("file_frequency_mhz must be positive", *given, file_frequency_mhz=frequency)
    refuse(r"'nowhere\.fits'.*sky\.file", *given)


@pytest.fixture
def pixels():
    return 1e5 + 1e3 * np.random.default_rng(3).standard_normal(12 * NSIDE**2)


def test_ulsa_file_is_read_as_it_is(test_data):
    path = test_data / "ulsa" / "exp10.0MHz_sky_map_with_absorption.hdf5"
    with h5py.File(path) as file:
        expected = file["smooth_absorb"][...]
    np.testing.assert_array_equal(ss.read_sky_file(path).pixels, expected)
    # the monopole is the mean pixel, but for what aliases into it from above lmax
    sky = lb.sky_from_file(path, 10.0, 47)
    assert sky.mean_temperature == pytest.approx(expected.mean(), rel=1e-6)


def test_a_point_source_shines_where_it_is():
    # the band-limited image of a source peaks at its position with K sr (lmax + 1)^2 / 4 pi
    lmax, source = 40, BRIGHT_SOURCES[0]
    modes = source.modes(25.0, lmax)
    l_deg, b_deg = source.galactic()
    at = synthesis_matrix(np.radians([90 - b_deg, 80 - b_deg]), np.radians([l_deg] * 2), lmax)
    values, flux = at @ modes, source.kelvin_steradian(25.0)
    assert values[0] == pytest.approx(flux * (lmax + 1) ** 2 / (4 * np.pi), rel=1e-12)
    assert abs(values[1]) < 0.1 * values[0]
    # its integral over the sky is its flux
    assert modes[0] * np.sqrt(4 * np.pi) == pytest.approx(flux, rel=1e-12)


def test_sources_are_added_to_the_galaxy():
    with_sources, without = lb.galaxy_sky(25.0, 8), lb.galaxy_sky(25.0, 8, sources=())
    added = sum(source.modes(25.0, 8) for source in BRIGHT_SOURCES)
    # the difference of numbers 1e5 times larger: rounding of the larger ones
    np.testing.assert_allclose(with_sources.modes - without.modes, added, atol=1e-9)


def with_one(pixels, value):
    return np.where(np.arange(pixels.size) == 7, value, pixels)


BAD_MAPS = [
    ("ORDERING is NESTED, expected RING", lambda to, x: write_fits(to, x, nest=True)),
    ("COORDSYS is C, expected G", lambda to, x: write_fits(to, x, coord="C")),
    ("NaN or infinity: nan at .7", lambda to, x: write_fits(to, with_one(x, np.nan))),
    ("has the unit 'Jy', expected K", lambda to, x: write_fits(to, x, "Jy")),
    ("neither HDF5, FITS nor", lambda to, x: to.write_text("not a map")),
    ("did you mean 'smooth_absorp'", lambda to, x: write_hdf5(to, smooth_absorp=x)),
    ("of a HEALPix map", lambda to, x: write_hdf5(to, smooth_absorb=x[:-1])),
]


@pytest.mark.parametrize(("words", "make"), BAD_MAPS, ids=lambda one: str(one)[:20])
def test_bad_maps_are_refused_in_one_sentence(tmp_path, pixels, make, words):
    make(tmp_path / "map.fits", pixels)
    refuse(words, ss.read_sky_file, tmp_path / "map.fits")


def test_millikelvin_are_converted_and_lmax_has_to_fit(tmp_path, pixels):
    path = tmp_path / "map.fits"
    write_fits(path, pixels, "mK")
    np.testing.assert_allclose(ss.read_sky_file(path).pixels, pixels / 1e3, rtol=1e-14)
    refuse("lmax = 48.*NSIDE 16", lb.sky_from_file, path, 10.0, 48)


def test_pixels_without_data(tmp_path, pixels, maps):
    gap, path = np.arange(pixels.size) < 10, tmp_path / "map.fits"
    for unit, partial in (("mK", False), ("K", True)):  # all pixels, or a list of those with data
        form = {"column_units": unit, "partial": partial, "overwrite": True, "dtype": np.float64}
        healpy.write_map(path, np.where(gap, healpy.UNSEEN, pixels), coord="G", **form)
        read = ss.read_sky_file(path)
        np.testing.assert_array_equal(read.unseen, gap)
        factor = 1e-3 if unit == "mK" else 1.0
        np.testing.assert_allclose(read.pixels[~gap], factor * pixels[~gap], rtol=1e-14)
        refuse("10 of.*UNSEEN", lb.sky_from_file, path, 25.0, 4)
    maps[9, 3] = healpy.UNSEEN
    cube = ss.SkyCube.read(path := write_cube(tmp_path / "cube.fits", maps))
    for mhz in (9.5, 10.0, 10.5):
        refuse("UNSEEN", cube.map_at, mhz)
    fits.setval(path, "ORDERING", value="NESTED")
    refuse("ORDERING is NESTED", ss.SkyCube.read, path)


def test_cubes_of_runs_have_any_frequencies(tmp_path, maps):
    mhz, scenario = np.array([1.0, 2.0, 5.0]), lb.load_scenario("fiducial")
    write_cubes(tmp_path, {"mean": maps[[0, 1, 4]]}, mhz, scenario)
    cube = ss.read_sky_file(tmp_path / "mean.fits")
    np.testing.assert_array_equal(cube.frequencies_mhz, mhz)
    index = np.where(np.arange(maps.shape[1]) % 2, -2.5, -2.1)
    np.testing.assert_allclose(cube.map_at(3.0), maps[0] * 3.0**index, rtol=1e-13)


CUBE_NSIDE = 8


@pytest.fixture
def maps():
    """Power laws of two indices, one for each half of the pixels."""
    at_one = 1e6 * (1.0 + np.random.default_rng(5).random(12 * CUBE_NSIDE**2))
    index = np.where(np.arange(at_one.size) % 2, -2.5, -2.1)
    return at_one * np.arange(1.0, 51.0)[:, None] ** index


def test_fifty_maps_and_what_is_between_them(tmp_path, maps):
    cube = ss.SkyCube.read(write_cube(tmp_path / "ULSA_32_ddi_smooth.fits", maps))
    np.testing.assert_array_equal(cube.frequencies_mhz, np.arange(1.0, 51.0))
    np.testing.assert_array_equal(cube.map_at(25.0), maps[24])
    np.testing.assert_array_equal(cube.map_at(50.0), maps[49])
    index = np.where(np.arange(maps.shape[1]) % 2, -2.5, -2.1)
    np.testing.assert_allclose(cube.map_at(7.3), maps[0] * 7.3**index, rtol=1e-13)


def test_a_scenario_with_a_cube(tmp_path, maps):
    path = write_cube(tmp_path / "cube.fits", maps)
    scenario = lb.load_scenario("fiducial", ["lmax=4", f"sky.file={path}"])
    sky, one = scenario.sky.at(scenario.frequency_mhz, scenario.lmax), tmp_path / "one.fits"
    healpy.write_map(one, maps[24], dtype=np.float64, column_units="K", coord="G")
    np.testing.assert_array_equal(sky.modes, lb.sky_from_file(one, 25.0, 4).modes)
    assert "50 HEALPix sky maps, NSIDE 8" in describe(path) and "1 to 50 MHz" in describe(path)


def test_cubes_that_cannot_be_used(tmp_path, maps):
    cube = ss.SkyCube.read(write_cube(tmp_path / "cube.fits", maps))
    refuse(r"1 to 50 MHz.*50\.5.*sky\.file_freq", cube.map_at, 50.5)
    refuse("expected 60 maps", ss.SkyCube.read, write_cube(tmp_path / "long.fits", maps, end=60))
    refuse("has 767 values", ss.SkyCube.read, write_cube(tmp_path / "odd.fits", maps[:, :-1]))
    in_hz = write_cube(tmp_path / "hz.fits", maps, start=1e6, step=1e6)
    refuse("is this Hz", ss.SkyCube.read, in_hz)
    for unit, factor in (("mK", 1e-3), ("K", 1.0)):
        path = write_cube(tmp_path / f"{unit}.fits", maps)
        fits.setval(path, "BUNIT", value=unit)
        np.testing.assert_allclose(ss.SkyCube.read(path).pixels, factor * maps, rtol=1e-15)
    fits.setval(path, "BUNIT", value="MJy/sr")
    refuse("unit 'MJy/sr'", ss.SkyCube.read, path)
    refuse("NaN or infinity", ss.SkyCube.read, write_cube(tmp_path / "holes.fits", np.nan * maps))
    negative = maps.copy()
    negative[9, 5] = -1.0
    cube = ss.SkyCube.read(write_cube(tmp_path / "negative.fits", negative))
    assert cube.map_at(10.0)[5] == -1.0
    refuse("not positive.*9 or 10 MHz", cube.map_at, 9.5)
    path = tmp_path / "cube.fits"
    path.write_bytes(path.read_bytes()[:10_000])
    refuse("truncated", lb.sky_from_file, path, 25.0, 4)


# --- coefficients -------------------------------------------------------------------------------


@pytest.fixture
def coefficients():
    return np.random.default_rng(6).standard_normal(81)


def test_coefficients_through_healpy_bit_by_bit(tmp_path, coefficients):
    modes = coefficients
    path = ss.write_alms(tmp_path / "alm.fits", modes, {"FREQ": 25.0})
    ours = from_healpy(healpy.read_alm(path))
    # sqrt(2) there and back again
    np.testing.assert_allclose(ours, modes, rtol=4e-16)
    np.testing.assert_array_equal(ss.SkyAlms.read(path).modes[0], ours)
    np.testing.assert_array_equal(lb.sky_from_file(path, 25.0, 8).modes, ours)
    # healpy's own file, and fewer coefficients than it has
    theirs = tmp_path / "healpy.fits"
    alm = healpy.map2alm(modes_to_map(modes, 16), lmax=8, iter=10)
    healpy.write_alm(theirs, alm, out_dtype=np.float64)
    np.testing.assert_array_equal(lb.sky_from_file(theirs, 25.0, 5).modes, from_healpy(alm)[:36])
    assert "coefficients of one sky up to ell = 8" in describe(theirs)


def test_luseepys_coefficients_of_many_frequencies(test_data):
    path = test_data / "luseepy" / "sky_alm.npz"
    sky = lb.sky_from_file(path, 25.0, 47)
    with np.load(path) as file:
        np.testing.assert_array_equal(sky.modes, from_healpy(file["alm"][4]))
    refuse("no coefficients.*12 MHz.*5, 10, 15", lb.sky_from_file, path, 12.0, 47)
    assert "coefficients of 10 skies up to ell = 47, 5, 10" in describe(path)


def test_coefficients_that_cannot_be_used(tmp_path, coefficients):
    path = ss.write_alms(tmp_path / "alm.fits", coefficients, {})
    refuse("ell = 8.*expected.* 9", lb.sky_from_file, path, 25.0, 9)
    with fits.open(path) as hdus:
        table = hdus[1].data
        fits.BinTableHDU(table[:-1], name="ALM").writeto(tmp_path / "short.fits")
        bad = table.copy()
        bad["index"][3] = 2  # ell = 1, m = -1
        fits.BinTableHDU(bad, name="ALM").writeto(tmp_path / "negative.fits")
    refuse("1 coefficients.*ell = 8.*missing", ss.SkyAlms.read, tmp_path / "short.fits")
    refuse("0 <= m <= ell", ss.SkyAlms.read, tmp_path / "negative.fits")
    np.savez(tmp_path / "a.npz", alm=np.zeros((2, 45), complex))
    refuse(r"no freq \(it has alm\)", ss.SkyAlms.read, tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", alm=np.zeros((2, 44), complex), freq=[1.0, 2.0])
    refuse("alm has 44 values", ss.SkyAlms.read, tmp_path / "b.npz")
    (tmp_path / "c.npz").write_text("nothing")
    refuse("cannot be read as coefficients", ss.SkyAlms.read, tmp_path / "c.npz")
