"""Times, orientations and bodies in the sky, against lunarsky, astropy and ERFA."""

from dataclasses import replace
from datetime import datetime

import astropy.units as u
import erfa
import numpy as np
import pytest
from assertions import refuse, within
from astropy import coordinates
from astropy.coordinates import ICRS, CartesianRepresentation, SkyCoord, get_body_barycentric
from astropy.time import Time
from lunarsky import MCMF, LunarTopo, MoonLocation
from reference import galactic_directions, vectors

import lusee_bayes as lb
from lusee_bayes.instrument.observation import MOON_RADIUS_KM, body_direction
from lusee_bayes.instrument.schedule import CYCLE_DAYS
from lusee_bayes.instrument.times import unannounced_leap_seconds

# the leap seconds of years far ahead are unknown; astropy says so whenever it converts them


def test_the_fiducial_cycle_and_three_of_them():
    one = lb.Observation.from_runs()
    assert one.n_times == 327 and one.times[0].isot == "2027-01-15T00:00:00.000"
    within(one.hours, 2.0 * np.arange(327), 1e-6)  # a double JD: 20 ns
    np.testing.assert_array_equal(np.unique(one.day), np.arange(28))
    assert one.day[5] == 0 and one.day[-1] == 652 // 24
    three = lb.Observation.from_runs([lb.Run(1.0, angle) for angle in (0.0, 30.0, 60.0)])
    assert (three.n_times, three.n_runs) == (981, 3)
    np.testing.assert_array_equal(np.bincount(three.run), [327, 327, 327])
    starts = three.hours[np.searchsorted(three.run, [0, 1, 2])]
    np.testing.assert_allclose(starts, 24 * CYCLE_DAYS * np.arange(3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_directions_agree_with_lunartopo(seed):
    rng = np.random.default_rng(seed)
    o = lb.Observation.from_runs(
        [lb.Run(0.6, 35.0), lb.Run(0.5, -110.0)],
        start=["2027-01-15T00:00:00", "1999-03-04T05:06:07"][seed],
        lon_deg=rng.uniform(-180, 360),
        lat_deg=rng.uniform(-90, 90),
    )
    to_topo = o.topocentric_from_mcmf() @ o.mcmf_from_galactic
    theta, phi = np.arccos(rng.uniform(-1, 1, 40)), rng.uniform(0, 2 * np.pi, 40)
    seen = vectors(theta, phi)
    for k in rng.integers(0, o.n_times, 5):
        there = vectors(*galactic_directions(theta, phi, o.times[k], o.lon_deg, o.lat_deg))
        # lunarsky goes through the same kernel; what is left is rounding of three rotations
        within(to_topo[k] @ there.T, seen.T, 1e-10)
        # of antennas on the turntable
        turned = phi[:1] + np.radians(o.turntable_deg[o.run[k]])
        site = o.times[k], o.lon_deg, o.lat_deg
        there = vectors(*galactic_directions(theta[:1], turned, *site))[0]
        within(o.antenna_directions(there)[k], seen[0], 1e-10)


def test_sun_altitude_agrees_with_lunarsky():
    o = lb.Observation.from_runs([lb.Run(1.0)], step_s=40000.0)
    got = o.sun_altitude_deg()
    site = MoonLocation.from_selenodetic(lon=o.lon_deg, lat=o.lat_deg)
    sun, moon = (get_body_barycentric(b, o.times, ephemeris="builtin") for b in ("sun", "moon"))
    away = (sun - moon).xyz.to_value(u.km)
    direction = ICRS(CartesianRepresentation(away / np.linalg.norm(away, axis=0)))
    by_frame = [direction[k].transform_to(LunarTopo(obstime=o.times[k], location=site)).alt.deg
                for k in range(o.n_times)]  # fmt: skip
    np.testing.assert_allclose(got, by_frame, rtol=0, atol=1e-7)


@pytest.mark.parametrize("start", ["1900-01-02T00:00:00", "2049-11-20T00:00:00"])
def test_times_inside_the_ephemeris_work(start):
    r = lb.Observation.from_runs([lb.Run(0.1)], start=start).mcmf_from_galactic
    np.testing.assert_allclose(np.linalg.det(r), 1.0, rtol=0, atol=1e-12)


OUTSIDE = "is outside the ephemeris, 1900 to 2050"
BAD_INPUT = [
    ({"start": "next tuesday"}, "'next tuesday' is not a date; write e.g. 2027-01-15"),
    ({"start": "1899-12-31T12:00:00"}, f"1899-12-31T12:00:00 {OUTSIDE}"),
    ({"start": "2051-03-01T00:00:00"}, f"2051-03-01T00:00:00 {OUTSIDE}"),
    # begins inside, ends outside
    ({"start": "2049-12-20T00:00:00"}, f"2050-01-16T04:00:00 {OUTSIDE}"),
    ({"step_s": 0.0}, "step_s must be positive, got 0.0"),
    ({"lat_deg": 95.0}, r"lat_deg must lie in -90..90, got 95.0"),
    ({"runs": [lb.Run(), lb.Run(1e-3)]}, "run 1 of 0.001 cycles has no sample of 7200.0 s"),
    ({"runs": []}, "at least one run"),
    ({"runs": [lb.Run(turntable_deg=float("nan"))]}, "turntable_deg.*NaN"),
    ({"runs": [lb.Run(-1.0)]}, "length in cycles of run 0 must be positive, got -1.0"),
    # the Sun is up for two weeks from 1 February 2027 at this site
    ({"runs": [lb.Run(0.1, night_only=True)], "start": "2027-02-05"}, "contains no lunar night"),
]


def test_times_of_any_scale_and_kind_are_stored_as_utc():
    expected = lb.Observation.from_runs(start="2027-01-15T01:00:00")
    for start in (datetime(2027, 1, 15, 1), Time("2027-01-15T01:00:00").tdb):
        within((lb.Observation.from_runs(start=start).times - expected.times).sec, 0.0, 1e-6)
    moved = replace(expected, times=expected.times.tdb)
    assert moved.times.scale == "utc" and "T01:00:00" in repr(moved)


@pytest.mark.parametrize(("options", "message"), BAD_INPUT)
def test_bad_input_is_refused(options, message):
    refuse(message, lb.Observation.from_runs, **options)


INCONSISTENT = [
    ([0, 1, 0], (0.0, 1.0), "run must count"),
    ([0, 2, 2], (0.0, 1.0, 2.0), "run must count"),
    ([0, 0, 1], (0.0,), "run must count 0, 1, ... up to 0"),
    ([0, 0], (0.0,), r"run has shape \(2,\), expected \(3,\)"),
]


@pytest.mark.parametrize(("run", "turntable", "message"), INCONSISTENT)
def test_inconsistent_samples_are_refused(run, turntable, message):
    times = Time("2027-01-15") + np.arange(3.0) * u.hour
    refuse(message, lb.Observation, 0.0, 0.0, times, np.array(run), turntable, 3600.0)


# --- Sun, Earth and planets -----------------------------------------------------------------------


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

    ERFA's series, light time by repetition, lunarsky's MCMF -> LunarTopo with a finite distance.
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
    degrees = {"lon": lon_deg * u.deg, "lat": lat_deg * u.deg}
    site = MoonLocation.from_selenodetic(**degrees, height=0.0 * u.m)
    radius = np.sqrt(site.x**2 + site.y**2 + site.z**2)
    site = MoonLocation.from_selenodetic(**degrees, height=MOON_RADIUS_KM * u.km - radius)
    here = LunarTopo(obstime=time, location=site)

    def seen(seconds_ago):
        away = place(seconds_ago, planet) - moon
        distance = np.linalg.norm(away)
        with unannounced_leap_seconds():
            unit = ICRS(CartesianRepresentation(away / distance)).transform_to(MCMF(obstime=time))
            xyz = unit.cartesian.xyz.value * distance * u.km
            centred = MCMF(CartesianRepresentation(xyz), obstime=time)
            return centred.transform_to(here).cartesian.xyz.to_value(u.km).ravel()

    seconds = 0.0
    for _ in range(5):  # each of which is 1e-4 of the one before
        seconds = np.linalg.norm(seen(seconds)) / LIGHT
    north, east, up = seen(seconds)  # azimuth counts from North towards East
    return np.array([east, north, up]) / np.linalg.norm([east, north, up])


BODIES = [("Sun", 0), ("Venus", 2), ("Earth", 3), ("Jupiter", 5), ("saturn", 6)]


@pytest.mark.parametrize(("body", "planet"), BODIES)
def test_directions_agree_with_erfa_and_lunartopo(body, planet):
    site = {"lon_deg": 23.4, "lat_deg": -61.0}
    observation = dates("2026-06-02T21:00:00", "2027-01-15T03:00:00", **site)
    to_topo = observation.topocentric_from_mcmf() @ observation.mcmf_from_galactic
    got = np.einsum("tij,tj->ti", to_topo, body_direction(body, observation))
    for k in range(2):
        expected = by_erfa_and_lunartopo(planet, observation.times[k], **site)
        # the same series by another way: rounding of rotations, and 1e-4 s of light time
        assert angle(got[k], expected) < 1e-3 * ARCSECOND


def test_jupiter_is_where_the_almanac_had_it():
    # opposition of 10 January 2026, in Gemini near Pollux: RA 7h 23m, Dec 22
    observation = dates("2026-01-10T00:00:00")
    gal = body_direction("Jupiter", observation)
    there = SkyCoord(coordinates.Galactic(CartesianRepresentation(gal[0]))).icrs
    assert there.ra.deg == pytest.approx(110.8, abs=1.0)
    assert there.dec.deg == pytest.approx(22.0, abs=0.5)
    assert angle(gal, -body_direction("Sun", observation))[0] < np.radians(1.5)


def test_unknown_bodies_are_refused():
    there, known = dates("2027-01-15T00:00:00"), "Earth, Jupiter, Mars, Mercury, Neptune, Saturn, "
    refuse("did you mean 'Saturn'", body_direction, "satrun", there)
    refuse(f"known: {known}Sun, Uranus, Venus", body_direction, "moon", there)
