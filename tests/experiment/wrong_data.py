"""Data with usual mistakes in them, of skies that are not the model's.

Each is made with what was really so (another turntable angle, other antennas, another site ...), or
by changing good data, and then says of itself what a scenario without the mistake expects.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import jax
import numpy as np
from made_skies import SmoothSky, SpottySky

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers, turn_about_z
from lusee_bayes.experiment.model import radiometer, set_up
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.products import labels
from lusee_bayes.sky.sky_source import SkySource
from lusee_bayes.systematics.context import Setup

LABELS = labels(4)


def scenario(lmax: int = 8, *overrides: str, frequency_mhz: float = 25.0) -> Scenario:
    """One cycle of 110 samples with every default, at one turntable angle."""
    sizes = {"frequency_mhz": frequency_mhz, "lmax": lmax, "observation.step_s": 21460.0}
    return changed(Scenario(), *(f"{k}={v}" for k, v in sizes.items()), *overrides)


def changed(scenario: Scenario, *overrides: str) -> Scenario:
    """A scenario with other entries, ``key.path=value`` as on the command line."""
    return lb.load_scenario(scenario, overrides)


@dataclass(frozen=True)
class Mixed(SkySource):
    """A smooth and a spotty sky, half and half: bright, positive, not the Galaxy."""

    seed: int = 1

    def at(self, frequency_mhz: float, lmax: int) -> lb.Sky:
        one, other = (s(self.seed).at(frequency_mhz, lmax) for s in (SmoothSky, SpottySky))
        return lb.Sky((one.modes + other.modes) / 2.0, float(frequency_mhz), "mixed sky")


def measured(
    truth: Scenario,
    sky: lb.Sky,
    seed: int = 1,
    *,
    beams: Callable[[Setup], ProductBeams] = lambda setup: setup.beams,
    distort: Callable[[Setup, np.ndarray], np.ndarray] = lambda setup, v: v,
    seen_by: Scenario | None = None,
) -> lb.Visibilities:
    """Data that ``truth`` describes, of a sky, with their noise; dated as ``seen_by`` says.

    The noise is that of the data's own visibilities.
    """
    setup = set_up(truth)
    coupling = lb.CouplingMatrix.build(beams(setup), setup.pointing)
    signal = np.asarray(setup.layout.scatter(coupling @ sky.modes))
    signal = signal + np.asarray(setup.background)
    signal = np.asarray(distort(setup, signal))
    noise = radiometer(replace(setup, signal=signal)).sample(jax.random.key(seed))
    nominal = setup if seen_by is None else set_up(seen_by)
    data, f = np.asarray(setup.layout.gather(signal) + noise), nominal.scenario.frequency_mhz
    return lb.Visibilities(data, setup.layout, nominal.observation, f, sky.modes)


def port_matrix(ports: list[int]) -> np.ndarray:
    """Products of data whose port number i is labelled number k where ``ports[k] = i``."""
    matrix = np.zeros((16, 16))
    for row, label in enumerate(LABELS):
        i, j = ports[int(label[0])], ports[int(label[1])]
        sign = -1.0 if label[2] == "I" and i > j else 1.0
        matrix[row, LABELS.index(f"{min(i, j)}{max(i, j)}{label[2]}")] = sign
    return matrix


def diagonal(**factors: float) -> np.ndarray:
    """Products times factors, by their labels; keys begin with p."""
    return np.diag([factors.get(f"p{label}", 1.0) for label in LABELS])


def exchanged(one: str, other: str) -> np.ndarray:
    order = list(range(16))
    i, j = LABELS.index(one), LABELS.index(other)
    order[i], order[j] = j, i
    return np.eye(16)[order]


def mirrored(setup: Setup) -> ProductBeams:
    """Beams with azimuth counted the other way: phi to -phi."""
    _, m = mode_numbers(setup.beams.lmax)
    return replace(setup.beams, modes=np.asarray(setup.beams.modes) * np.where(m < 0, -1.0, 1.0))


def from_north(setup: Setup) -> ProductBeams:
    """Beams whose phi was counted from North towards East: phi to 90 degrees - phi."""
    modes = turn_about_z(np.asarray(mirrored(setup).modes), np.pi / 2.0)
    return replace(setup.beams, modes=np.asarray(modes))


Make = Callable[[Scenario, lb.Sky, int], lb.Visibilities]


@dataclass(frozen=True)
class Wrong:
    """Wrong data: what is wrong, words of the proposal that names it, and how to make them."""

    name: str
    cause: str
    make: Make


def _on_grid(change: Callable[[np.ndarray], np.ndarray]) -> Make:
    """Good data whose visibilities on the grid are changed."""

    def make(scenario: Scenario, sky: lb.Sky, seed: int) -> lb.Visibilities:
        data = measured(scenario, sky, seed)
        return replace(data, data=np.asarray(data.layout.gather(change(np.asarray(data.grid())))))

    return make


def _mix(matrix: np.ndarray) -> Make:
    """Each time's products, mixed: ``matrix @ products``."""
    return _on_grid(lambda grid: matrix @ grid)


def _other(*overrides: str) -> Make:
    """Taken as the scenario with overrides says, dated as without them."""
    return lambda scenario, sky, seed: measured(
        changed(scenario, *overrides), sky, seed, seen_by=scenario
    )


def _beams(beams: Callable[[Setup], ProductBeams]) -> Make:
    return lambda scenario, sky, seed: measured(scenario, sky, seed, beams=beams)


def shifted_by(mhz: float) -> Callable[[Setup], ProductBeams]:
    """Beams of a neighbouring channel."""
    return lambda s: s.beam_source.beams(s.scenario.frequency_mhz + mhz, s.scenario.lmax)


def _finer(scenario: Scenario, sky: lb.Sky, seed: int) -> lb.Visibilities:
    """Of a sky with structure to lmax + 8."""
    finer = changed(scenario, f"lmax={scenario.lmax + 8}")
    whole = Mixed(seed).at(scenario.frequency_mhz, finer.lmax)
    data = measured(finer, whole, seed, seen_by=scenario)
    return replace(data, truth=whole.modes[: len(sky.modes)])


def _opposite(scenario: Scenario, sky: lb.Sky, seed: int) -> lb.Visibilities:
    """Taken at -20 degrees, dated as at 20."""
    angle = "observation.runs.0.turntable_deg"
    here, there = (changed(scenario, f"{angle}={value}") for value in (-20, 20))
    return measured(here, sky, seed, seen_by=there)


def _one_time(factor: float, time: int) -> Make:
    return _on_grid(lambda grid: grid * np.where(np.arange(grid.shape[1]) == time, factor, 1.0))


def _constant(kelvin: float) -> Make:
    autos = np.array([label[0] == label[1] for label in LABELS])
    return lambda scenario, sky, seed: measured(
        scenario, sky, seed, distort=lambda _, v: v + kelvin * autos[:, None]
    )


def _exchanged_ports(i: int, j: int) -> Wrong:
    ports = port_matrix([{i: j, j: i}.get(k, k) for k in range(4)])
    return Wrong(f"ports {i} and {j} exchanged", f"ports {i} and {j}", _mix(ports))


def _turned_ports(n: int) -> Wrong:
    ports = port_matrix([(k + n) % 4 for k in range(4)])
    return Wrong(f"ports turned by {n}", f"ports are rotated by {4 - n}", _mix(ports))


def _turned_table(angle: int) -> Wrong:
    there = _other(f"observation.runs.0.turntable_deg={angle}")
    return Wrong(f"turntable at {angle}", f"rotated by {angle}", there)


AUTOS = {f"p{label}": 1.1 for label in LABELS if label[0] == label[1]}
PORT_2 = {f"p{x}": 1.03 ** (x[:2].count("2")) for x in LABELS}
CONJUGATED = {f"p{x}": -1.0 for x in LABELS if x[2] == "I"}
FLIPPED_1 = {f"p{x}": -1.0 for x in LABELS if x[:2].count("1") == 1}

WRONG = (
    Wrong("imaginary parts conjugated", "conjugated", _mix(diagonal(**CONJUGATED))),
    Wrong("polarity of port 1", "port 1 have the wrong sign", _mix(diagonal(**FLIPPED_1))),
    *(_exchanged_ports(i, j) for i, j in combinations(range(4), 2)),
    *(_turned_ports(n) for n in (1, 2, 3)),
    *(_turned_table(angle) for angle in (90, 180, 270)),
    Wrong("sign of the turntable", "angles have the wrong sign", _opposite),
    Wrong("mirrored beams", "mirrored", _beams(mirrored)),
    Wrong("azimuth from North", "counted from North", _beams(from_north)),
    Wrong("01R and 02R exchanged", "01R and 02R", _mix(exchanged("01R", "02R"))),
    Wrong("03I and 12I exchanged", "03I and 12I", _mix(exchanged("03I", "12I"))),
    Wrong("00 and 22 exchanged", "00R and 22R", _mix(exchanged("00R", "22R"))),
    Wrong("autos 10 % too high", "every auto", _mix(diagonal(**AUTOS))),
    Wrong("02I 2 % too high", "product 02I", _mix(diagonal(p02I=1.02))),
    Wrong("33R 1 % too high", "product 33R", _mix(diagonal(p33R=1.01))),
    Wrong("13R has the other sign", "product 13R", _mix(diagonal(p13R=-1.0))),
    Wrong("port 2 3 % too high", "port 2's voltage", _mix(diagonal(**PORT_2))),
    Wrong("constant in the autos", "constant", _constant(200.0)),
    Wrong("times reversed", "reversed", _on_grid(lambda grid: grid[:, ::-1])),
    Wrong("one time 2 % too high", "all products at 2027-01-", _one_time(1.02, 37)),
    Wrong("one time 50 % too low", "all products at 2027-01-", _one_time(0.5, 60)),
    Wrong("latitude's sign", "latitude", _other("observation.lat_deg=23.814")),
    Wrong("beams of 1 MHz more", "neighbouring channel", _beams(shifted_by(1.0))),
    Wrong("beams of 1 MHz less", "neighbouring channel", _beams(shifted_by(-1.0))),
    Wrong("noise 4 times as large", "noise variance", _other("noise.radiometer.factor=4")),
    Wrong("noise a quarter", "noise variance", _other("noise.radiometer.factor=0.25")),
    Wrong("lmax too small", "beyond lmax", _finer),
    Wrong("another height", "height", _other("beam.height_m=1.8")),
)


# what is not in the table of usual mistakes
UNMODELLED = (
    Wrong("permittivity 5 % off", "", _other("beam.surface_permittivity=3.885")),
    Wrong("arms 1 degree off", "", _other("beam.zenith_angle_deg=76")),
    Wrong("three times the loss", "", _other("beam.loss_tangent=0.03")),
    Wrong("beams of 0.2 MHz more", "", _beams(shifted_by(0.2))),
)
