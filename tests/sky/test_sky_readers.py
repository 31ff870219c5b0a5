"""Skies from files and their coefficients."""

import h5py
import healpy
import jax.numpy as jnp
import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map, synthesis_matrix
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES
from lusee_bayes.sky.sky_source import Sky, galaxy_sky, read_sky_file, sky_from_file

NSIDE = 16


@pytest.fixture
def pixels():
    rng = np.random.default_rng(3)
    return 1e5 + 1e3 * rng.standard_normal(12 * NSIDE**2)


def write_fits(path, pixels, **keywords):
    healpy.write_map(path, pixels, dtype=np.float64, column_units="K", overwrite=True, **keywords)
    return path


def test_fits_and_hdf5_give_back_the_same_pixels(tmp_path, pixels):
    fits = write_fits(tmp_path / "map.fits", pixels, coord="G")
    with h5py.File(tmp_path / "map.hdf5", "w") as file:
        file["smooth_absorb"] = pixels
    np.testing.assert_array_equal(read_sky_file(fits).pixels, pixels)
    np.testing.assert_array_equal(read_sky_file(tmp_path / "map.hdf5").pixels, pixels)


def test_millikelvin_are_converted(tmp_path, pixels):
    path = tmp_path / "map.fits"
    healpy.write_map(path, pixels, dtype=np.float64, column_units="mK", coord="G")
    np.testing.assert_allclose(read_sky_file(path).pixels, pixels / 1e3, rtol=1e-14)


def test_ulsa_file_is_read_as_it_is(test_data):
    path = test_data / "ulsa" / "exp10.0MHz_sky_map_with_absorption.hdf5"
    with h5py.File(path) as file:
        expected = file["smooth_absorb"][...]
    np.testing.assert_array_equal(read_sky_file(path).pixels, expected)
    # the monopole is the mean pixel, but for what aliases into it from above lmax
    sky = sky_from_file(path, 10.0, 47)
    assert sky.mean_temperature == pytest.approx(expected.mean(), rel=1e-6)


def test_coefficients_give_the_map_back(tmp_path):
    # a band-limited map goes through map -> modes -> map to healpy's iterated quadrature (1e-10)
    rng = np.random.default_rng(0)
    modes = rng.standard_normal(81)
    path = write_fits(tmp_path / "map.fits", modes_to_map(modes, NSIDE), coord="G")
    np.testing.assert_allclose(sky_from_file(path, 10.0, 8).modes, modes, atol=1e-9)


def bad_files():
    def nested(folder, pixels):
        return write_fits(folder / "x.fits", pixels, nest=True)

    def equatorial(folder, pixels):
        return write_fits(folder / "x.fits", pixels, coord="C")

    def holes(folder, pixels):
        return write_fits(folder / "x.fits", np.where(np.arange(pixels.size) == 7, np.nan, pixels))

    def unseen(folder, pixels):
        values = np.where(np.arange(pixels.size) == 7, healpy.UNSEEN, pixels)
        return write_fits(folder / "x.fits", values)

    def flux(folder, pixels):
        path = folder / "x.fits"
        healpy.write_map(path, pixels, dtype=np.float64, column_units="Jy", overwrite=True)
        return path

    def text(folder, pixels):
        (folder / "x.fits").write_text("not a map")
        return folder / "x.fits"

    def other_dataset(folder, pixels):
        with h5py.File(folder / "x.hdf5", "w") as file:
            file["smooth_absorp"] = pixels
        return folder / "x.hdf5"

    def not_healpix(folder, pixels):
        with h5py.File(folder / "x.hdf5", "w") as file:
            file["smooth_absorb"] = pixels[:-1]
        return folder / "x.hdf5"

    def missing(folder, pixels):
        return folder / "nowhere.fits"

    return [
        (nested, "ORDERING is NESTED, expected RING"),
        (equatorial, "COORDSYS is C, expected G"),
        (holes, "NaN or infinity: nan at .7"),
        (unseen, "1 of 3072 pixels are UNSEEN"),
        (flux, "unit is 'Jy', expected a temperature"),
        (text, "neither HDF5 nor FITS"),
        (other_dataset, "no dataset 'smooth_absorb' .*did you mean 'smooth_absorp'"),
        (not_healpix, "not a HEALPix map"),
        (missing, "no sky map at"),
    ]


@pytest.mark.parametrize(("make", "message"), bad_files(), ids=lambda x: getattr(x, "__name__", ""))
def test_bad_files_are_refused_in_one_sentence(tmp_path, pixels, make, message):
    with pytest.raises(InputError, match=message) as caught:
        read_sky_file(make(tmp_path, pixels))
    assert "\n" not in str(caught.value)


def test_lmax_beyond_the_file_is_refused(tmp_path, pixels):
    path = write_fits(tmp_path / "map.fits", pixels, coord="G")
    with pytest.raises(InputError, match="lmax = 48 is too large for a map of NSIDE 16"):
        sky_from_file(path, 10.0, 48)


def test_a_point_source_shines_where_it_is():
    # the band-limited image of a source peaks at its position with K sr (lmax + 1)^2 / 4 pi
    lmax, source = 40, BRIGHT_SOURCES[0]
    modes = source.modes(25.0, lmax)
    l_deg, b_deg = source.galactic()
    at = synthesis_matrix(np.radians([90 - b_deg, 80 - b_deg]), np.radians([l_deg] * 2), lmax)
    values = at @ modes
    flux = source.kelvin_steradian(25.0)
    assert values[0] == pytest.approx(flux * (lmax + 1) ** 2 / (4 * np.pi), rel=1e-12)
    assert abs(values[1]) < 0.1 * values[0]
    # its integral over the sky is its flux
    assert modes[0] * np.sqrt(4 * np.pi) == pytest.approx(flux, rel=1e-12)


def test_sources_are_added_to_the_galaxy():
    with_sources, without = galaxy_sky(25.0, 8), galaxy_sky(25.0, 8, sources=())
    added = sum(source.modes(25.0, 8) for source in BRIGHT_SOURCES)
    # the difference of numbers 1e5 times larger: rounding of the larger ones
    np.testing.assert_allclose(
        np.asarray(with_sources.modes) - np.asarray(without.modes), added, atol=1e-9
    )


def test_sky_refuses_other_precision():
    with pytest.raises(InputError, match="float64"):
        Sky(jnp.zeros(9, dtype=jnp.float32), 25.0)
