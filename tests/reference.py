"""Slow, obvious physics, written without the package: what its fast code must agree with.

Nothing here imports lusee_bayes. Harmonics come from scipy, directions from lunarsky's LunarTopo
frame, reflection from 2 x 2 characteristic matrices, antenna currents from vectors in space. Frames
and conventions: topocentric x East, y North, z up; theta from the zenith, phi from East towards
North; packed real modes at ell^2 + ell + m; time convention exp(+i w t).
"""

import astropy.units as u
import numpy as np
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from lunarsky import MCMF, LunarTopo, MoonLocation
from scipy import integrate, special

SPEED_OF_LIGHT = 299792458.0


def real_harmonics(theta, phi, lmax):
    """Orthonormal real harmonics, (points, modes), from scipy's complex ones."""
    ell, m = np.array([(ell, m) for ell in range(lmax + 1) for m in range(-ell, ell + 1)]).T
    y = special.sph_harm_y(ell, np.abs(m), np.asarray(theta)[..., None], np.asarray(phi)[..., None])
    return np.where(m < 0, -y.imag, y.real) * np.where(m == 0, 1.0, np.sqrt(2.0))


def vectors(theta, phi):
    """Unit vectors, components last."""
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def tangents(theta, phi):
    """Unit vectors along growing theta and along growing phi, components last."""
    return vectors(theta + np.pi / 2, phi), vectors(np.pi / 2 + 0 * theta, phi + np.pi / 2)


def unit_vectors(grid):
    """Unit vectors of a grid of theta and phi, components first."""
    return np.moveaxis(vectors(*np.meshgrid(grid.theta, grid.phi, indexing="ij")), -1, 0)


def steep_sky(lmax, seed=0, monopole=1e4):
    """Modes of a sky as steep as the Galaxy's: C_ell ~ (1 + ell)^-2.5 around a monopole, in K."""
    ell = np.repeat(np.arange(lmax + 1), 2 * np.arange(lmax + 1) + 1)
    a = np.random.default_rng(seed).standard_normal(len(ell))
    a *= 0.5 * monopole * (1.0 + ell) ** -1.25
    a[0] = monopole * np.sqrt(4 * np.pi)
    return a


def hemisphere(n_theta, n_phi):
    """theta, phi and solid angle of directions that cover the hemisphere above the horizon."""
    return sphere(n_theta, n_phi, lowest=0.0)


def sphere(n_theta, n_phi, lowest=-1.0):
    """The same of the whole sphere, or down to a cosine: Gauss nodes in it, equal steps in phi."""
    x, w = np.polynomial.legendre.leggauss(n_theta)
    half, phi = (1.0 - lowest) / 2.0, 2.0 * np.pi * (np.arange(n_phi) + 0.5) / n_phi
    grid = np.meshgrid(np.arccos(1.0 + half * (x - 1.0)), phi, indexing="ij")
    theta, phi = (a.ravel() for a in grid)
    return theta, phi, np.repeat(w * half, n_phi) * 2.0 * np.pi / n_phi


def galactic_directions(theta, phi, time, lon_deg, lat_deg):
    """Galactic colatitude and longitude of topocentric directions at one time."""
    site = MoonLocation.from_selenodetic(lon=lon_deg, lat=lat_deg)
    az, alt = ((np.pi / 2 - angle) * u.rad for angle in (phi, theta))
    here = LunarTopo(az=az, alt=alt, obstime=time, location=site)
    there = here.transform_to(ICRS()).transform_to(Galactic())
    return np.pi / 2 - there.b.rad, there.l.rad


def is_dark(times, lon_deg, lat_deg):
    """Whether the Sun is down at each time, as lunarsky has the site and the Moon."""
    site = MoonLocation.from_selenodetic(lon=lon_deg, lat=lat_deg)
    sun, moon = (get_body_barycentric(body, times, ephemeris="builtin") for body in ("sun", "moon"))
    vector = (sun - moon).xyz.to_value(u.km)
    icrs = ICRS(CartesianRepresentation(vector / np.linalg.norm(vector, axis=0)))
    mcmf = icrs.transform_to(MCMF(obstime=times)).cartesian.xyz.value
    return np.array([x.to_value(u.m) for x in (site.x, site.y, site.z)]) @ mcmf < 0


def visibilities(response, grid, sky, time, *, lon_deg, lat_deg, turntable_deg=0.0):
    """sum over directions of response x sky x solid angle, for each product (first axis).

    ``response``, (products, points), belongs to the antennas at turntable angle zero, at the
    directions of ``grid`` (theta, phi, solid angle); turning the antennas moves those directions.
    """
    theta, phi, solid_angle = grid
    directions = galactic_directions(theta, phi + np.radians(turntable_deg), time, lon_deg, lat_deg)
    lmax = round(np.sqrt(len(sky))) - 1
    return response @ ((real_harmonics(*directions, lmax) @ sky) * solid_angle)


def layered_reflection(permittivities, thickness_m, cos_theta, frequency_mhz):
    """(s, p) of a stack by characteristic matrices of tangential E and H (Born & Wolf 1.6.2).

    ``permittivities``: of the layers from the top, the last without end; all others are
    ``thickness_m`` thick. s is the ratio of the reflected to the incident tangential E, p that of
    the tangential H.
    """
    k, ratios = 2.0e6 * np.pi * frequency_mhz / SPEED_OF_LIGHT, []
    for polarisation in "sp":

        def admittance(eps, polarisation=polarisation):
            q = np.sqrt(complex(eps - (1.0 - cos_theta**2)))
            q = -q if q.imag > 0 else q  # decays downwards under exp(+i w t)
            return q, q if polarisation == "s" else q / eps

        matrix = np.eye(2, dtype=complex)
        for eps in permittivities[:-1]:
            q, y = admittance(eps)
            delta = k * q * thickness_m
            cos, sin = np.cos(delta), 1j * np.sin(delta)
            matrix = matrix @ np.array([[cos, sin / y], [y * sin, cos]])
        _, y0 = admittance(1.0)
        _, y_end = admittance(permittivities[-1])
        u_top, v_top = matrix @ np.array([1.0, y_end])
        ratios.append((y0 * u_top - v_top) / (y0 * u_top + v_top))
    return tuple(ratios)


def arm_response(
    theta, phi, *, frequency_mhz, length, arm, height=0.0, reflection=(0.0, 0.0), steps=4001
):
    """E_theta, E_phi of one arm (unit vector) by Simpson's rule along it, in one direction.

    A plane wave comes from n with its electric field along e; its mirror image in the ground at
    z = -height comes from n' with the field e' that the reflection (s, p) leaves.
    """
    k, s = 2.0e6 * np.pi * frequency_mhz / SPEED_OF_LIGHT, np.linspace(0.0, length, steps)
    current = np.sin(k * (length - s))
    n, (e_theta, e_phi) = vectors(theta, phi), tangents(theta, phi)
    mirrored = n * np.array([1.0, 1.0, -1.0])
    r_s, r_p = reflection
    # H of the theta wave is horizontal and scales by p; E = H x (direction of travel)
    reflected_theta = -r_p * e_theta * np.array([1.0, 1.0, -1.0])
    reflected_phi = r_s * e_phi
    detour, answers = np.exp(-2j * k * height * n[2]), []
    for direct, reflected in ((e_theta, reflected_theta), (e_phi, reflected_phi)):
        wave = (arm @ direct) * np.exp(1j * k * s * (arm @ n))
        echo = (arm @ reflected) * np.exp(1j * k * s * (arm @ mirrored)) * detour
        answers.append(integrate.simpson(current * (wave + echo), x=s))
    return tuple(answers)
