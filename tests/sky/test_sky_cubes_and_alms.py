"""Skies of many frequencies and skies as coefficients, from files."""

from __future__ import annotations

import healpy
import numpy as np
import pytest
from astropy.io import fits

import lusee_bayes as lb
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import from_healpy, modes_to_map
from lusee_bayes.report.describe import describe
from lusee_bayes.sky.sky_files import SkyAlms, SkyCube, write_alms
from lusee_bayes.sky.sky_source import sky_from_file

NSIDE = 8


def write_cube(path, maps, start=1, end=None, step=1):
    """The cards of ULSA_32_ddi_smooth.fits: integers, two of them beyond eight letters."""
    hdu = fits.PrimaryHDU(maps)
    hdu.header["HIERARCH FREQ_START"] = start
    hdu.header["FREQ_END"] = start + step * (len(maps) - 1) if end is None else end
    hdu.header["HIERARCH FREQ_STEP"] = step
    hdu.header["NSIDE"] = NSIDE
    hdu.header["TYPE"] = "ulsa"
    hdu.writeto(path)
    return path


@pytest.fixture
def maps():
    """Power laws of two indices, one for each half of the pixels."""
    rng = np.random.default_rng(5)
    at_one = 1e6 * (1.0 + rng.random(12 * NSIDE**2))
    index = np.where(np.arange(at_one.size) % 2, -2.5, -2.1)
    return at_one * np.arange(1.0, 51.0)[:, None] ** index


def test_fifty_maps_and_what_is_between_them(tmp_path, maps):
    cube = SkyCube.read(write_cube(tmp_path / "ULSA_32_ddi_smooth.fits", maps))
    np.testing.assert_array_equal(cube.frequencies_mhz, np.arange(1.0, 51.0))
    np.testing.assert_array_equal(cube.map_at(25.0), maps[24])
    np.testing.assert_array_equal(cube.map_at(50.0), maps[49])
    index = np.where(np.arange(maps.shape[1]) % 2, -2.5, -2.1)
    np.testing.assert_allclose(cube.map_at(7.3), maps[0] * 7.3**index, rtol=1e-13)


def test_a_scenario_with_a_cube(tmp_path, maps):
    path = write_cube(tmp_path / "cube.fits", maps)
    scenario = lb.load_scenario("fiducial", ["lmax=4", f"sky.file={path}"])
    sky = scenario.sky.source().at(scenario.frequency_mhz, scenario.lmax)
    one = tmp_path / "one.fits"
    healpy.write_map(one, maps[24], dtype=np.float64, column_units="K", coord="G")
    np.testing.assert_array_equal(sky.modes, sky_from_file(one, 25.0, 4).modes)
    # one of its maps, scaled
    scaled = sky_from_file(path, 25.0, 4, file_frequency_mhz=10.0, spectral_index=-2.0)
    ten = sky_from_file(path, 10.0, 4)
    np.testing.assert_allclose(scaled.modes, ten.modes * 2.5**-2.0, rtol=1e-13)
    assert "50 HEALPix sky maps, NSIDE 8" in describe(path)
    assert "1 to 50 MHz" in describe(path)


def test_cubes_that_cannot_be_used(tmp_path, maps):
    cube = SkyCube.read(write_cube(tmp_path / "cube.fits", maps))
    with pytest.raises(InputError, match=r"from 1 to 50 MHz, not at 50.5; set sky.file_freq"):
        cube.map_at(50.5)
    with pytest.raises(InputError, match="expected 60 maps for 1 to 60 MHz in steps of 1"):
        SkyCube.read(write_cube(tmp_path / "long.fits", maps, end=60))
    with pytest.raises(InputError, match="767 values are not a HEALPix map"):
        SkyCube.read(write_cube(tmp_path / "odd.fits", maps[:, :-1]))
    with pytest.raises(InputError, match="is this Hz"):
        SkyCube.read(write_cube(tmp_path / "hz.fits", maps, start=1e6, step=1e6))
    for unit, factor in (("mK", 1e-3), ("K", 1.0)):
        path = write_cube(tmp_path / f"{unit}.fits", maps)
        fits.setval(path, "BUNIT", value=unit)
        np.testing.assert_allclose(SkyCube.read(path).pixels, factor * maps, rtol=1e-15)
    fits.setval(path, "BUNIT", value="MJy/sr")
    with pytest.raises(InputError, match="unit 'MJy/sr'"):
        SkyCube.read(path)
    holes = maps.copy()
    holes[3, 5] = np.nan
    with pytest.raises(InputError, match="NaN or infinity"):
        SkyCube.read(write_cube(tmp_path / "holes.fits", holes))
    negative = maps.copy()
    negative[9, 5] = -1.0
    cube = SkyCube.read(write_cube(tmp_path / "negative.fits", negative))
    assert cube.map_at(10.0)[5] == -1.0
    with pytest.raises(InputError, match="not positive at 9 or 10 MHz"):
        cube.map_at(9.5)
    path = tmp_path / "cube.fits"
    path.write_bytes(path.read_bytes()[:10_000])
    with pytest.raises(InputError, match="cut short"):
        sky_from_file(path, 25.0, 4)


# --- coefficients -------------------------------------------------------------------------------


@pytest.fixture
def modes():
    return np.random.default_rng(6).standard_normal(81)


def test_coefficients_through_healpy_bit_by_bit(tmp_path, modes):
    path = write_alms(tmp_path / "alm.fits", modes, {"FREQ": 25.0})
    ours = from_healpy(healpy.read_alm(path))
    # sqrt(2) there and back again
    np.testing.assert_allclose(ours, modes, rtol=4e-16)
    np.testing.assert_array_equal(SkyAlms.read(path).modes[0], ours)
    np.testing.assert_array_equal(sky_from_file(path, 25.0, 8).modes, ours)
    # healpy's own file, and fewer coefficients than it has
    theirs = tmp_path / "healpy.fits"
    alm = healpy.map2alm(modes_to_map(modes, 16), lmax=8, iter=10)
    healpy.write_alm(theirs, alm, out_dtype=np.float64)
    np.testing.assert_array_equal(sky_from_file(theirs, 25.0, 5).modes, from_healpy(alm)[:36])
    assert "coefficients of one sky up to ell = 8" in describe(theirs)


def test_luseepys_coefficients_of_many_frequencies(test_data):
    path = test_data / "luseepy" / "sky_alm.npz"
    sky = sky_from_file(path, 25.0, 47)
    with np.load(path) as file:
        np.testing.assert_array_equal(sky.modes, from_healpy(file["alm"][4]))
    with pytest.raises(InputError, match=r"no coefficients at 12 MHz \(it has 5, 10, 15"):
        sky_from_file(path, 12.0, 47)
    scaled = sky_from_file(path, 12.0, 47, file_frequency_mhz=10.0)
    ten = sky_from_file(path, 10.0, 47)
    np.testing.assert_allclose(scaled.modes, ten.modes * 1.2**-2.5, rtol=1e-13)
    assert "coefficients of 10 skies up to ell = 47, 5, 10" in describe(path)


def test_coefficients_that_cannot_be_used(tmp_path, modes):
    path = write_alms(tmp_path / "alm.fits", modes, {})
    with pytest.raises(InputError, match="up to ell = 8, not up to 9"):
        sky_from_file(path, 25.0, 9)
    with fits.open(path) as hdus:
        table = hdus[1].data
        fits.BinTableHDU(table[:-1], name="ALM").writeto(tmp_path / "short.fits")
        bad = table.copy()
        bad["index"][3] = 2  # ell = 1, m = -1
        fits.BinTableHDU(bad, name="ALM").writeto(tmp_path / "negative.fits")
    with pytest.raises(InputError, match="1 coefficients up to ell = 8 are missing"):
        SkyAlms.read(tmp_path / "short.fits")
    with pytest.raises(InputError, match="0 <= m <= ell"):
        SkyAlms.read(tmp_path / "negative.fits")
    np.savez(tmp_path / "a.npz", alm=np.zeros((2, 45), complex))
    with pytest.raises(InputError, match=r"no freq \(it has alm\)"):
        SkyAlms.read(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", alm=np.zeros((2, 44), complex), freq=[1.0, 2.0])
    with pytest.raises(InputError, match=r"alm has 44 coefficients"):
        SkyAlms.read(tmp_path / "b.npz")
    (tmp_path / "c.npz").write_text("nothing")
    with pytest.raises(InputError, match=r"cannot be read as coefficients"):
        SkyAlms.read(tmp_path / "c.npz")
