"""Pointing: turntable, tilt, azimuth and clock, and their possible offsets.

The orientation of the lander at every time is split so that time enters only through scalars. In
the frame P whose z axis is the mean pole of the Moon over the samples, the rotation to the
Moon-fixed frame is a turn phi(t) about z followed by a small tilt, exactly::

    MCMF <- P  at t  =  exp(ex(t) K_x + ey(t) K_y)  exp(phi(t) K_z).

The pole wanders by 0.04 degrees over one cycle, so the tilt is expanded in powers of (ex, ey); the
order is chosen such that the largest neglected term is below ``TILT_TOLERANCE`` of any mode.
:mod:`.averaging` computes means over windows, and the functions of time in A.

**Offsets** of clock and pointing are errors of times, turntable angles and the site. Each is the
correction to add to the value of data or scenario. They shift an observation exactly
(:func:`with_offsets`: times, turntable angles, site and lean of the lander), or a pointing inside a
compiled function (:func:`turned_by_offsets`). The latter assumes that within the clock's offset the
Moon turns at a constant rate about a fixed pole: its error is less than 1e-3 of the offset's own
effect on the data.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.core.arrays import Array, Times, Values, namespace
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.harmonics import Rotation
from lusee_bayes.instrument import averaging, schedule
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import Windows, later

Tilts = Float[np.ndarray, "times 2"]
# bound on the relative error of a mode at lmax, and lowest order for any lmax
TILT_TOLERANCE = 1e-7
LEAST_ORDER = 2
# upper bound on the Moon's rotation rate, in radians per second
FASTEST_TURN = 2.0 * np.pi / (27.3 * 86400.0)


class Pointing(eqx.Module):
    """Orientation of the sky above the antennas at every sample, for harmonics up to one lmax.

    Attributes
    ----------
    azimuth : (times,) array
        phi(t) in radians, its mean over the window of each sample.
    functions : (times, functions) array
        u_j(t), the other functions of time in A.
    factors : (functions, powers, orders, 2) array
        Real and imaginary part of G_j(p, m), which the beams absorb for each function.
    pole_frame : (3, 3) array
        The rotation of vectors from Galactic coordinates to the frame P.
    pole_from_galactic : Rotation
        The same rotation for harmonics.
    mcmf_from_lander : Rotation
        From the frame of the lander, at turntable angle zero, to the Moon-fixed one.
    turntable : (runs,) array
        In radians, positive from East towards North.
    run_starts : tuple of int
        First sample of each run, and the number of samples.
    order : int
        Order of the expansion in the tilt.
    turns : (4,) array or None
        Further turns in radians if offsets are unknowns: of the site in longitude and latitude, and
        of the lander towards East and towards North. None for no turns.
    """

    azimuth: Float[Array, " times"]
    functions: Float[Array, "times functions"]
    factors: Float[Array, "functions powers orders 2"]
    pole_frame: Float[Array, "3 3"]
    pole_from_galactic: Rotation
    mcmf_from_lander: Rotation
    turntable: Float[Array, " runs"]
    run_starts: tuple[int, ...] = eqx.field(static=True)
    order: int = eqx.field(static=True)
    turns: Float[Array, "4"] | None = None

    @classmethod
    def of(
        cls, observation: Observation, lmax: int, order: int | None = None, pole_frame: Any = None
    ) -> Pointing:
        """Return the pointing of every sample of an observation.

        Parameters
        ----------
        observation : Observation
        lmax : int
        order : int, optional
            Order of the expansion in the tilt: 0 fixes the axis at its mean; by default the lowest
            one whose error is negligible, see :func:`sufficient_order`.
        pole_frame : (3, 3) array, optional
            The frame of another observation at about the same time; by default that of this one's
            mean pole.

        Returns
        -------
        Pointing

        Raises
        ------
        InputError
            If the order is negative.
        """
        if order is not None and order < 0:
            raise InputError(f"the order of the tilt expansion must be 0, 1, ..., got {order}")
        windows = observation.windows
        longest = 0.0 if windows is None else float((windows.end_s - windows.start_s).max())
        n = averaging.sufficient_nodes(lmax * FASTEST_TURN * longest / 2.0)
        instants, sample, weight = observation.at_nodes(n)
        mcmf = instants.mcmf_from_galactic
        pole_frame = mean_pole_frame(mcmf) if pole_frame is None else pole_frame
        azimuth, tilt = split(mcmf @ pole_frame.T)
        order = sufficient_order(tilt, lmax) if order is None else order
        of_time = averaging.windowed(sample, weight, azimuth, tilt, order, lmax)
        starts = np.searchsorted(observation.run, np.arange(observation.n_runs + 1)).tolist()
        frames = pole_frame, Rotation.from_matrix(pole_frame, lmax), *_lander(observation, lmax)
        return cls(*of_time, *frames, run_starts=tuple(starts), order=order)

    def placed(self, observation: Observation) -> Pointing:
        """Return the pointing of an observation at the same times and windows, but elsewhere.

        Parameters
        ----------
        observation : Observation
            Provides site, lean and turntable angles.
        """
        lander, turntable = _lander(observation, len(self.mcmf_from_lander.blocks) - 1)
        return replace(self, mcmf_from_lander=lander, turntable=turntable)

    @property
    def n_times(self) -> int:
        """Number of samples."""
        return self.azimuth.shape[0]

    def runs(self) -> list[tuple[int, slice]]:
        """Return the number of each run and the slice of its samples."""
        bounds = zip(self.run_starts[:-1], self.run_starts[1:], strict=True)
        return [(number, slice(first, end)) for number, (first, end) in enumerate(bounds)]


def _lander(observation: Observation, lmax: int) -> tuple[Rotation, Array]:
    """The rotation from the lander to the Moon, and the turntable's angles in radians."""
    angles = np.array(observation.turntable_deg, dtype=np.float64)
    return Rotation.from_matrix(observation.lander_from_mcmf().T, lmax), np.radians(angles)


def mean_pole_frame(mcmf: Float[np.ndarray, "times 3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from Galactic axes to axes whose z is the Moon's mean pole."""
    z = mcmf[:, 2].mean(axis=0)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)  # the Moon's pole lies 60 degrees from the Galactic one
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def split(rotations: Float[np.ndarray, "times 3 3"]) -> tuple[Times, Tilts]:
    """Split rotations exactly: R = exp(ex K_x + ey K_y) exp(phi K_z).

    Parameters
    ----------
    rotations : (times, 3, 3) array

    Returns
    -------
    azimuth : (times,) array
        phi in radians.
    tilt : (times, 2) array
        (ex, ey) in radians.
    """
    pole = rotations[:, :, 2]  # image of z: only the tilt moves it
    horizontal = np.hypot(pole[:, 0], pole[:, 1])
    angle = np.arctan2(horizontal, pole[:, 2])
    # angle / sin(angle) -> 1 if the axis does not move at all
    stretch = np.divide(angle, horizontal, out=np.ones_like(angle), where=horizontal > 0)
    tilt = np.stack([-pole[:, 1], pole[:, 0]], axis=1) * stretch[:, None]
    vectors = np.concatenate([tilt, np.zeros((len(tilt), 1))], axis=1)
    about_z = SpatialRotation.from_rotvec(vectors).inv().as_matrix() @ rotations
    return np.arctan2(about_z[:, 1, 0], about_z[:, 0, 0]), tilt


def sufficient_order(tilt: Tilts, lmax: int) -> int:
    """Return the lowest order of the expansion in the tilt whose error is negligible.

    This is the lowest n >= LEAST_ORDER with ``(lmax |tilt|)^(n+1) / (n+1)! < TILT_TOLERANCE``.
    """
    size = lmax * float(np.hypot(tilt[:, 0], tilt[:, 1]).max())
    return max(averaging.terms_of_exponential(size, TILT_TOLERANCE) - 1, LEAST_ORDER)


# true time minus the data's at the first sample, in seconds, and its increase per day
CLOCK = ("clock_s", "clock_drift_s_per_day")
# lean of the lander towards East and towards North
TILTS = ("tilt_east_deg", "tilt_north_deg")
SITE = ("lon_deg", "lat_deg")
# these, and the turntable of every run, from East towards North
OFFSETS = (*CLOCK, "turntable_deg", *SITE, *TILTS)
# change of the azimuth phi per hour as the Moon turns, in radians
TURN_PER_HOUR = -2.0 * np.pi / (schedule.CYCLE_DAYS * 24.0)


def offset_names(kinds: tuple[str, ...], n_runs: int) -> tuple[str, ...]:
    """Return the name of every offset: each run has its own turntable angle.

    Parameters
    ----------
    kinds : tuple of str
        Some of ``OFFSETS``.
    n_runs : int
        Number of runs.

    Returns
    -------
    tuple of str
        ``turntable_deg`` becomes turntable_0_deg, turntable_1_deg, ... for several runs.

    Raises
    ------
    InputError
        If a kind is unknown.
    """
    names: list[str] = []
    for kind in kinds:
        require_known("unknown offset", kind, OFFSETS)
        names += _of_runs(n_runs) if kind == "turntable_deg" else [kind]
    return tuple(names)


def offset_kind(name: str) -> str:
    """Return the kind of ``OFFSETS`` that an offset's name belongs to."""
    return "turntable_deg" if name.startswith("turntable_") else name


def _of_runs(n_runs: int) -> list[str]:
    return ["turntable_deg"] if n_runs == 1 else [f"turntable_{run}_deg" for run in range(n_runs)]


def with_offsets(observation: Observation, values: Values) -> Observation:
    """Return the true observation from the nominal one and its offsets.

    Parameters
    ----------
    observation : Observation
        The nominal one, from data or a scenario.
    values : mapping of float
        By the names of :func:`offset_names`; missing ones are zero.

    Returns
    -------
    Observation
        With shifted times and windows, turntable angles, site and lean.
    """
    given = {name: float(value) for name, value in values.items()}
    drift = given.get("clock_drift_s_per_day", 0.0)
    stretch = 1.0 + drift / 86400.0
    times = later(observation.times, given.get("clock_s", 0.0) + drift * observation.hours / 24.0)
    angles = zip(observation.turntable_deg, _of_runs(observation.n_runs), strict=True)
    if (windows := observation.windows) is not None:
        sizes = (stretch * x for x in (windows.start_s, windows.end_s, windows.live_s))
        windows = Windows(windows.sample, *sizes)
    leans = zip(observation.tilt_deg, TILTS, strict=True)
    moved: dict[str, Any] = {n: getattr(observation, n) + given.get(n, 0.0) for n in SITE}
    moved["turntable_deg"] = tuple(angle + given.get(name, 0.0) for angle, name in angles)
    moved["tilt_deg"] = tuple(lean + given.get(name, 0.0) for lean, name in leans)
    step_s = observation.step_s * stretch
    return replace(observation, times=times, step_s=step_s, windows=windows, **moved)


def turned_by_offsets(pointing: Pointing, hours: Array, values: Values) -> Pointing:
    """Apply offsets to a pointing; differentiable in the offsets.

    Parameters
    ----------
    pointing : Pointing
        The pointing without offsets.
    hours : (times,) array
        Hours since the first sample.
    values : mapping of () array
        By the names of :func:`offset_names`; missing ones are zero.

    Returns
    -------
    Pointing
        With ``turns``, and with turntable and azimuth shifted.
    """
    xp = namespace(pointing, *values.values())
    given = {name: xp.asarray(value, dtype=np.float64) for name, value in values.items()}
    zero = xp.zeros(())
    late_h = given.get("clock_s", zero) / 3600.0
    drift, radians = given.get("clock_drift_s_per_day", zero) / 86400.0, np.pi / 180.0
    # a lander further East sees the sky as it will be later
    lon = given.get("lon_deg", zero) * radians - TURN_PER_HOUR * late_h
    angles = [given.get(name, zero) * radians for name in ("lat_deg", *TILTS)]
    names = _of_runs(len(pointing.run_starts) - 1)
    turntable = pointing.turntable + xp.stack([given.get(name, zero) * radians for name in names])
    azimuth = pointing.azimuth + TURN_PER_HOUR * drift * hours
    return replace(pointing, azimuth=azimuth, turntable=turntable, turns=xp.stack([lon, *angles]))
