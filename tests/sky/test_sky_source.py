"""Every source of skies keeps the same contract; files of every layout are scaled alike."""

from __future__ import annotations

import h5py
import healpy
import numpy as np
import pytest
from astropy.io import fits
from made_skies import SmoothSky, SpottySky
from reference import real_harmonics

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import map_to_modes, modes_to_map, to_healpy
from lusee_bayes.sky.sky_files import SkyAlms, SkyCube, SkyMap, write_alms
from lusee_bayes.sky.sky_source import (
    SKY_READERS,
    FileSource,
    GalaxySource,
    read_sky_file,
    sky_from_file,
)
from lusee_bayes.testing.checks import assert_refused, check_sky_source

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


def fits_map(path, modes):
    pixels = modes_to_map(modes, NSIDE)
    healpy.write_map(path, pixels, dtype=np.float64, column_units="K", coord="G")


def hdf5_map(path, modes):
    with h5py.File(path, "w") as file:
        file["other"] = modes_to_map(modes, NSIDE)


def cube(path, modes):
    """The same sky at 24, 25 and 26 MHz."""
    hdu = fits.PrimaryHDU(np.tile(modes_to_map(modes, NSIDE), (3, 1)))
    for key, value in (("FREQ_START", 24), ("FREQ_END", 26), ("FREQ_STEP", 1)):
        hdu.header[f"HIERARCH {key}"] = value
    hdu.writeto(path)


def fits_alms(path, modes):
    write_alms(path, modes, {})


def npz_alms(path, modes):
    np.savez(path, alm=np.tile(to_healpy(modes), (3, 1)), freq=[24.0, 25.0, 26.0])


# name of the file, who writes it, who reads it, and whether it says its frequencies
LAYOUTS = [
    ("map.fits", fits_map, SkyMap, False),
    ("map.hdf5", hdf5_map, SkyMap, False),
    ("cube.fits", cube, SkyCube, True),
    ("alm.fits", fits_alms, SkyAlms, False),
    ("alm.npz", npz_alms, SkyAlms, True),
]
of_every_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout[0])


def written(layout, folder, modes):
    name, write, _, _ = layout
    write(folder / name, modes)
    return folder / name, "other" if name.endswith("hdf5") else None


@of_every_layout
def test_files_keep_the_contract(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    source = FileSource(path, dataset)
    check_sky_source(
        source,
        frequency_mhz=25.0,
        lmax=LMAX,
        slice_rtol=BAND_LIMITED,
        missing_mhz=10.0 if layout[3] else None,
        missing_lmax=3 * NSIDE,
    )
    assert source.at(25.0, LMAX).name == path.name
    np.testing.assert_allclose(source.at(25.0, LMAX).modes, modes, rtol=0, atol=1e-9 * modes[0])


@of_every_layout
def test_files_are_scaled_from_their_frequency(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    there = FileSource(path, dataset).at(25.0, LMAX)
    scaled = FileSource(path, dataset, 25.0, -2.1).at(10.0, LMAX)
    assert scaled.frequency_mhz == 10.0
    np.testing.assert_allclose(scaled.modes, np.asarray(there.modes) * 0.4**-2.1, rtol=1e-13)
    # the function of one frequency, and the paper's index by default
    again = sky_from_file(path, 10.0, LMAX, dataset=dataset, file_frequency_mhz=25.0)
    np.testing.assert_allclose(again.modes, np.asarray(there.modes) * 0.4**-2.5, rtol=1e-13)


@of_every_layout
def test_exactly_one_reader_reads_a_file(layout, tmp_path, modes):
    path, dataset = written(layout, tmp_path, modes)
    found = next(reader for reader in SKY_READERS if reader.recognises(path))
    assert found is layout[2]
    assert isinstance(read_sky_file(path, dataset), found)
    assert all(line.strip() for line in read_sky_file(path, dataset).summary())


def test_the_galaxy_keeps_the_contract():
    # the Galaxy's map of NSIDE 64 has power above lmax: up to 2.1e-5 between 8 and 48
    source = GalaxySource()
    check_sky_source(source, frequency_mhz=25.0, lmax=16, slice_rtol=1e-4, missing_mhz=60.0)
    assert_refused(lambda: source.at(0.5, 16))


@pytest.mark.parametrize("kind", [SmoothSky, SpottySky])
def test_the_test_skies_keep_the_contract(kind):
    # the background's plane has power above lmax, 6e-6 between 8 and 191
    check_sky_source(kind(), frequency_mhz=10.0, lmax=16, slice_rtol=1e-4)
    mean = kind().at(20.0, 8).mean_temperature
    assert mean == pytest.approx(3e5 * 2**-2.5, rel=0.05)
    first, second = (np.asarray(kind(seed).at(10.0, 8).modes) for seed in (1, 2))
    assert np.abs(first - second).max() > 1e-3 * np.abs(first).max()


def test_the_smooth_sky_is_positive_and_smooth():
    for seed in range(5):
        sky = SmoothSky(seed)
        pattern = sky.pattern()
        assert pattern.min() > 0.0
        spectrum = np.asarray(sky.at(10.0, 31).spectrum())
        # blobs of 15 degrees: exp(-(ell sigma)^2), 1e-9 of the power at ell = 20
        assert spectrum[20:].max() < 1e-6 * spectrum[1:4].max()


def test_the_spotty_sky_has_a_steep_number_count():
    """N(> 2 S) / N(> S) = 2^-1.5 within the scatter of counts; sources add up to a tenth."""
    theta, phi, share = SpottySky().sources()
    for level in (2.0, 5.0):
        above = share > level * share.min()
        brighter = int((share > 2.0 * level * share.min()).sum())
        expected = above.sum() * 2.0**-1.5
        assert abs(brighter - expected) < 4.0 * np.sqrt(expected)
    assert share.sum() == pytest.approx(1.0)
    assert SpottySky().background().min() > 0.0
    # half of them lie in the plane
    latitude = 90.0 - np.degrees(theta)
    assert 0.5 < np.mean(np.abs(latitude) < 15.0) < 0.75
    # one source after the other, by its own harmonics
    sky = SpottySky().at(10.0, 4)
    modes = 0.9 * map_to_modes(SpottySky().background(), 4)
    for t, p, s in zip(theta, phi, share, strict=True):
        modes += 0.1 * 4.0 * np.pi * s * real_harmonics(t, p, 4)
    np.testing.assert_allclose(sky.modes, 3e5 * modes, rtol=0, atol=1e-9 * 3e5)


@pytest.mark.parametrize("frequency", [0.0, -3.0, np.nan])
def test_a_files_frequency_is_positive(frequency):
    with pytest.raises(InputError, match="file_frequency_mhz must be positive"):
        FileSource("nowhere.fits", file_frequency_mhz=frequency)


def test_a_file_that_is_not_there():
    with pytest.raises(InputError, match="no sky map at 'nowhere.fits'; check sky.file"):
        FileSource("nowhere.fits").at(25.0, LMAX)
