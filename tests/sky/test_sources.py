"""Bright sources: catalogued positions, published fluxes that were not used, units."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.sky import galaxy
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES

SOURCES = {source.name: source for source in BRIGHT_SOURCES}


def test_all_nine_are_there():
    names = {"Cas A", "Cyg A", "Vir A", "Tau A", "Cen A", "For A", "Her A", "Hyd A", "Pic A"}
    assert set(SOURCES) == names and len(BRIGHT_SOURCES) == 9


@pytest.mark.parametrize(
    "name, lon_deg, lat_deg",
    [
        ("Cas A", 111.7, -2.1),  # SNR G111.7-2.1 (Green's catalogue)
        ("Tau A", 184.6, -5.8),  # SNR G184.6-5.8
        ("Cyg A", 76.19, 5.76),  # SIMBAD, as are those below
        ("Vir A", 283.78, 74.49),
        ("Cen A", 309.52, 19.42),
        ("For A", 240.16, -56.69),
        ("Her A", 23.05, 28.95),
        ("Hyd A", 242.93, 25.09),
        ("Pic A", 251.60, -34.63),
    ],
)
def test_galactic_positions(name, lon_deg, lat_deg):
    # Catalogues round to 0.1 degree (Green) or 0.01.
    assert SOURCES[name].galactic() == pytest.approx((lon_deg, lat_deg), abs=0.06)


@pytest.mark.parametrize(
    "name, frequency_mhz, flux_jy, tolerance",
    [
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
    ],
)
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
    peak = frequency_mhz[np.argmax(flux)] / source.turnover_mhz
    assert 1.2 < peak < 2.7


@pytest.mark.parametrize("name", ["Vir A", "Tau A", "Cen A", "For A", "Her A", "Hyd A", "Pic A"])
def test_unmeasured_turnovers_are_those_of_the_embedded_electrons(name):
    # Rounded to 0.1 MHz of 1.2: 4 % in nu_t, 9 % in depth; the nu^-2.1 law adds up to 7 %.
    source = SOURCES[name]
    lon_deg, lat_deg = source.galactic()
    slabs = galaxy.Slabs.towards(np.array([lon_deg]), np.array([lat_deg]))
    _, depth = slabs.synchrotron(source.turnover_mhz)
    assert depth[0 if lat_deg > 0 else 1, 0] == pytest.approx(1.0, rel=0.16)


def test_kelvin_steradian_is_the_rayleigh_jeans_law():
    # A disc of 1 K and 0.01 sr at 30 MHz: S = 2 k T Omega / lambda^2, lambda = 9.993 m.
    wavelength = 299792458.0 / 30e6
    flux_jy = 2.0 * 1.380649e-23 * 0.01 / wavelength**2 / 1e-26
    source = dataclasses.replace(
        SOURCES["Cyg A"], log_flux=(np.log10(flux_jy),), valid_from_mhz=1.0
    )
    assert source.kelvin_steradian(30.0) == pytest.approx(0.01, rel=1e-12)
    # Cyg A at 38 MHz, 25.5 kJy: lambda = 7.889 m gives 574.8 K sr; its flux is held to 1 %.
    assert SOURCES["Cyg A"].kelvin_steradian(38.0) == pytest.approx(574.8, rel=0.01)


def test_frozen_and_refuses_bad_frequencies():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SOURCES["Cyg A"].ra_deg = 0.0
    for bad in (0.0, -3.0, float("nan")):
        with pytest.raises(InputError, match="expected positive"):
            SOURCES["Cyg A"].flux_jy(bad)
