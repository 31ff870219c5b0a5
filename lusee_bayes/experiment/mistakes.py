"""The usual mistakes in data and models, each as what would undo it.

A mistake in the data is undone by mixing the products of every time. One in the model is undone by
other beams, or by another observation: other times, angles or another site.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import mode_numbers, turn_about_z
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.instrument.beams import ProductBeams
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing_offsets import with_offsets
from lusee_bayes.instrument.products import all_products

Mixing = Float[np.ndarray, "products products"]

# seconds to be added to times that are not what they are taken for
CLOCKS = {
    "the times are TT or TDB, not UTC": -69.184,
    "the times are TAI, not UTC": -37.0,
    "the times are an hour early": 3600.0,
    "the times are an hour late": -3600.0,
    "the times are a day early": 86400.0,
    "the times are a day late": -86400.0,
}


@dataclass(frozen=True)
class DataMistake:
    """A mistake in the data.

    Attributes
    ----------
    words, remedy : str
        What is wrong, and what to do.
    mixing : (products, products) array
        What makes the right products of each time's wrong ones.
    constant : (products,) array or None
        What is then taken away, in K.
    time : int or None
        The only time that is wrong; None for all.
    reverses : bool
        Whether the order of times is reversed.
    """

    words: str
    remedy: str
    mixing: Mixing
    constant: Float[np.ndarray, " products"] | None = None
    time: int | None = None
    reverses: bool = False

    def undone(
        self, grid: Float[np.ndarray, "products times"]
    ) -> Float[np.ndarray, "products times"]:
        """The visibilities without the mistake, in K."""
        grid = grid[:, ::-1] if self.reverses else grid
        mixed = self.mixing @ grid
        if self.constant is not None:
            mixed = mixed - self.constant[:, None]
        if self.time is None:
            return mixed
        return np.where(np.arange(grid.shape[1]) == self.time, mixed, grid)


@dataclass(frozen=True)
class ModelMistake:
    """A mistake in the model.

    Attributes
    ----------
    words, remedy : str
        What is wrong, and what to do.
    beams : ProductBeams
        Those without the mistake.
    observation : Observation
        That without the mistake.
    """

    words: str
    remedy: str
    beams: ProductBeams
    observation: Observation


def port_mixing(ports: tuple[int, ...], signs: tuple[float, ...] | None = None) -> Mixing:
    """What makes the products of ports 0, 1, ... of data that have them as ``ports``.

    Parameters
    ----------
    ports : tuple of int
        Of each port, under which number the data have it.
    signs : tuple of float, optional
        Of each port, the sign of its voltage.
    """
    products, signs = all_products(len(ports)), signs or (1.0,) * len(ports)
    place = {tuple(product): k for k, product in enumerate(products)}
    mixing = np.zeros((len(products), len(products)))
    for row, (a, b, part) in enumerate(products):
        i, j = ports[a], ports[b]
        conjugated = -1.0 if part == "I" and i > j else 1.0
        mixing[row, place[min(i, j), max(i, j), part]] = conjugated * signs[a] * signs[b]
    return mixing


def data_mistakes(n_ports: int) -> Iterator[DataMistake]:
    """Conjugation, signs, exchanges, and reversed times."""
    products, ports = all_products(n_ports), tuple(range(n_ports))
    same = np.eye(len(products))
    imaginary = np.array([p.part == "I" for p in products])
    crosses = np.array([p.i != p.j for p in products])
    yield DataMistake(
        "the data are conjugated: the imaginary parts have the other sign",
        "change their sign (from_arrays: convention='conj(s_i) s_j')",
        np.diag(np.where(imaginary, -1.0, 1.0)),
    )
    yield DataMistake(
        "all crosses have the other sign",
        "change their sign",
        np.diag(np.where(crosses, -1.0, 1.0)),
    )
    for size in range(1, n_ports // 2 + 1):
        for flipped in combinations(ports, size):
            if 2 * size == n_ports and 0 not in flipped:  # as if the others were flipped
                continue
            named = " and ".join(map(str, flipped))
            yield DataMistake(
                f"the voltages of port {named} have the other sign",
                f"change the sign of all crosses of port {named} with others",
                port_mixing(ports, tuple(-1.0 if p in flipped else 1.0 for p in ports)),
            )
    for i, j in combinations(ports, 2):
        yield DataMistake(
            f"ports {i} and {j} are exchanged",
            f"exchange ports {i} and {j} of the data",
            port_mixing(tuple({i: j, j: i}.get(port, port) for port in ports)),
        )
    for turn in range(1, n_ports):
        yield DataMistake(
            f"the ports are turned by {turn}: the model's port 0 is the data's port {turn}",
            "number the data's ports as the beams'",
            port_mixing(tuple((port + turn) % n_ports for port in ports)),
        )
    for i, j in combinations(range(len(products)), 2):
        order = np.arange(len(products))
        order[[i, j]] = j, i
        named = f"{products[i].label} and {products[j].label}"
        yield DataMistake(
            f"products {named} are exchanged", f"exchange {named} of the data", same[order]
        )
    yield DataMistake("the times are reversed", "sort the data by time", same, reverses=True)


def model_mistakes(setup: Setup) -> Iterator[ModelMistake]:
    """Angles, azimuths, clocks, the site's signs, and neighbouring channels."""
    observation, beams = setup.observation, setup.beams
    angles = observation.turntable_deg

    def seen(words: str, remedy: str, other: Observation) -> ModelMistake:
        return ModelMistake(words, remedy, beams, other)

    for turn in (90.0, 180.0, 270.0):
        yield seen(
            f"the array is turned by {turn:g} degrees from East towards North",
            f"use --set beam.turntable_offset_deg={turn:g}",
            replace(observation, turntable_deg=tuple(angle + turn for angle in angles)),
        )
    if any(angles):
        yield seen(
            "the turntable's angles have the other sign",
            "count them from East towards North",
            replace(observation, turntable_deg=tuple(-angle for angle in angles)),
        )
    _, m = mode_numbers(beams.lmax)
    mirrored = np.asarray(beams.modes) * np.where(m < 0, -1.0, 1.0)
    for words, modes in (
        ("the azimuth of the beams is mirrored", mirrored),
        (
            "the azimuth of the beams is counted from North towards East",
            np.asarray(turn_about_z(mirrored, np.pi / 2.0)),
        ),
    ):
        remedy = "count it from East towards North"
        yield ModelMistake(words, remedy, replace(beams, modes=modes), observation)
    half = observation.step_s / 2.0
    starts = {"the times are starts of samples": half, "the times are ends of samples": -half}
    for words, seconds in (CLOCKS | starts).items():
        shifted = with_offsets(observation, {"clock_s": seconds})
        yield seen(words, f"add {seconds:g} s to the times", shifted)
    for name, key in (("latitude", "lat_deg"), ("longitude", "lon_deg")):
        value = getattr(observation, key)
        yield seen(
            f"the site's {name} has the other sign",
            f"use --set observation.{key}={-value:g}",
            with_offsets(observation, {key: -2.0 * value}),
        )
    width = setup.scenario.noise.radiometer.bandwidth_hz / 1e6
    for frequency in (beams.frequency_mhz - width, beams.frequency_mhz + width):
        try:
            other = setup.beam_source.beams(frequency, beams.lmax)
        except InputError:  # the source has none there
            continue
        yield ModelMistake(
            f"the frequency is that of the neighbouring channel, {frequency:g} MHz",
            f"use --set frequency_mhz={frequency:g}",
            other,
            observation,
        )
