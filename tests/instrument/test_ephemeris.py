import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, SkyCoord
from astropy.time import Time
from closeness import within
from lunarsky import MCMF, LunarTopo, MoonLocation

import lusee_bayes as lb
from lusee_bayes.instrument.ephemeris import BODIES, MOON_RADIUS_KM, body_direction
from lusee_bayes.instrument.times import unannounced_leap_seconds

AU_KM = 149597870.7
LIGHT = 299792.458
ARCSECOND = np.pi / 648000


def angle(a, b):
    """Angle between unit vectors along the last axis, in radians."""
    return 2.0 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2.0)


def dates(*isot, lon_deg=182.258, lat_deg=-23.814):
    run = np.zeros(len(isot), dtype=int)
    return lb.Observation(lon_deg, lat_deg, Time(list(isot)), run, (0.0,), 60.0)


def by_erfa_and_lunartopo(planet, time, lon_deg, lat_deg):
    """East, North, up of a planet of plan94, the Sun (0) or the Earth (3), at one time.

    ERFA's series, light time by bisection, lunarsky's MCMF -> LunarTopo with a finite distance.
    """
    with unannounced_leap_seconds():
        tdb = time.tdb

    def place(seconds_ago, planet):
        jd2 = tdb.jd2 - seconds_ago / 86400.0
        heliocentric, barycentric = (x["p"] for x in erfa.epv00(tdb.jd1, jd2))
        if planet == 3:
            return barycentric * AU_KM
        sun = barycentric - heliocentric
        if planet == 0:
            return sun * AU_KM
        return (sun + erfa.plan94(tdb.jd1, jd2, planet)["p"]) * AU_KM

    moon = place(0.0, 3) + erfa.moon98(tdb.jd1, tdb.jd2)["p"] * AU_KM
    site = MoonLocation.from_selenodetic(lon=lon_deg * u.deg, lat=lat_deg * u.deg, height=0.0 * u.m)
    radius = np.sqrt(site.x**2 + site.y**2 + site.z**2)
    site = MoonLocation.from_selenodetic(
        lon=lon_deg * u.deg, lat=lat_deg * u.deg, height=MOON_RADIUS_KM * u.km - radius
    )
    here = LunarTopo(obstime=time, location=site)

    def seen(seconds_ago):
        away = place(seconds_ago, planet) - moon
        distance = np.linalg.norm(away)
        with unannounced_leap_seconds():
            unit = ICRS(CartesianRepresentation(away / distance)).transform_to(MCMF(obstime=time))
            centred = MCMF(
                CartesianRepresentation(unit.cartesian.xyz.value * distance * u.km), obstime=time
            )
            return centred.transform_to(here).cartesian.xyz.to_value(u.km).ravel()

    early, late = 0.0, 40000.0
    while late - early > 1e-4:
        middle = (early + late) / 2.0
        if np.linalg.norm(seen(middle)) > LIGHT * middle:
            early = middle
        else:
            late = middle
    north, east, up = seen(late)  # azimuth counts from North towards East
    distance = np.linalg.norm([east, north, up])
    return np.array([east, north, up]) / distance, distance / AU_KM


@pytest.mark.parametrize(
    ("body", "planet"), [("Sun", 0), ("Venus", 2), ("Earth", 3), ("Jupiter", 5), ("saturn", 6)]
)
def test_directions_agree_with_erfa_and_lunartopo(body, planet):
    site = {"lon_deg": 23.4, "lat_deg": -61.0}
    observation = dates("2026-06-02T21:00:00", "2027-01-15T03:00:00", **site)
    to_topo = observation.topocentric_from_mcmf() @ observation.mcmf_from_galactic()
    got = np.einsum("tij,tj->ti", to_topo, body_direction(body, observation))
    for k in range(2):
        expected, _ = by_erfa_and_lunartopo(planet, observation.times[k], **site)
        # the same series by another way: rounding of rotations, and 1e-4 s of light time
        assert angle(got[k], expected) < 1e-3 * ARCSECOND


def test_the_sun_is_where_the_observation_says():
    observation = lb.Observation.from_runs([lb.Run(1.0)], step_s=40000.0)
    up = np.sum(observation.zenith_galactic() * body_direction("Sun", observation), axis=1)
    # 1737 km at 1 au are 2.4 arcseconds, the barycentric Sun moves 0.01 km/s x 499 s = 0.01
    within(np.degrees(np.arcsin(up)), observation.sun_altitude_deg(), 2.5 / 3600)


def test_jupiter_is_where_the_almanac_had_it():
    # opposition of 10 January 2026, in Gemini near Pollux: RA 7h 23m, Dec 22
    observation = dates("2026-01-10T00:00:00")
    gal = body_direction("Jupiter", observation)
    there = SkyCoord(Galactic(CartesianRepresentation(gal[0]))).icrs
    assert there.ra.deg == pytest.approx(110.8, abs=1.0)
    assert there.dec.deg == pytest.approx(22.0, abs=0.5)
    assert angle(gal, -body_direction("Sun", observation))[0] < np.radians(1.5)


def test_two_landers_see_the_earth_against_different_stars():
    # both on the great circle at right angles to the Earth's direction near 0 E, 0 N: the poles
    north = dates("2027-01-15T00:00:00", lat_deg=90.0, lon_deg=0.0)
    south = dates("2027-01-15T00:00:00", lat_deg=-90.0, lon_deg=0.0)
    site = {"lon_deg": 0.0, "lat_deg": 0.0}
    _, distance = by_erfa_and_lunartopo(3, north.times[0], **site)
    centre_km = distance * AU_KM
    assert 350000 < centre_km < 407000
    a, b = body_direction("Earth", north), body_direction("Earth", south)
    parallax = angle(a, b)[0]
    # 2 x 1737.4 / distance = 0.52 degrees; the libration, 7 degrees, shortens the base by < 1 %
    assert parallax == pytest.approx(2 * 1737.4 / centre_km, rel=1e-2)
    # the northern lander sees the Earth displaced towards the south
    assert np.sum((a - b) * north.zenith_galactic()) < -0.99 * parallax
    # and the Sun hardly at all
    sun = angle(body_direction("Sun", north), body_direction("Sun", south))[0]
    assert 4.0 * ARCSECOND < sun < 5.0 * ARCSECOND


def test_light_time():
    # it moves a planet by its own motion: Jupiter, 13 km/s over 35 to 50 minutes, 5-9"
    later = dates("2027-01-15T00:00:00")
    with unannounced_leap_seconds():
        tdb = later.times.tdb
        heliocentric, barycentric = (x["p"] for x in erfa.epv00(tdb.jd1, tdb.jd2))
        moon = barycentric + erfa.moon98(tdb.jd1, tdb.jd2)["p"]
        at_once = barycentric - heliocentric + erfa.plan94(tdb.jd1, tdb.jd2, 5)["p"] - moon
    galactic = (
        ICRS(CartesianRepresentation(at_once[0])).transform_to(Galactic()).cartesian.xyz.value
    )
    moved = angle(galactic / np.linalg.norm(galactic), body_direction("Jupiter", later)[0])
    assert 5.0 * ARCSECOND < moved < 10.0 * ARCSECOND


def test_every_body_is_known_in_any_case():
    observation = dates("2027-01-15T00:00:00")
    for body in BODIES:
        vector = body_direction(body.upper(), observation)
        np.testing.assert_allclose(np.linalg.norm(vector, axis=1), 1.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("Jupitre", "unknown body 'Jupitre' in the sky of the Moon; did you mean 'Jupiter'?"),
        ("satrun", "did you mean 'Saturn'"),
        ("xyz", "known: Earth, Jupiter, Mars"),
        ("moon", "unknown body 'moon'"),
    ],
)
def test_unknown_bodies_are_refused(body, message):
    with pytest.raises(lb.InputError, match=message):
        body_direction(body, dates("2027-01-15T00:00:00"))
