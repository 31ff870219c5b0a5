"""Beams of files over a grid of parameters, interpolated between them.

Simulations of the antennas at several values of, for example, permittivity and tilt form one source
of beams, whose parameters can be unknowns. A table in CSV describes the files: a column ``file``,
relative to the table, and a column for each parameter, with a row for every combination of their
values.

Beams are sums over the files, B(p) = sum_k w_k(p) B_k. The weights are products over the
parameters: polynomials through up to five values, cubic splines through more. The emission of the
ground and of the antennas' losses is interpolated likewise.

**Unit.** Receivers measure volts, and 1 K is defined by the antennas at nominal values p_0, U(p_0),
whatever the impedances at p: B_k U_k / U(p_0) is interpolated, with U the root of U_aa U_bb of a
product's ports (:mod:`.luseepy_files`). Sources without volts are interpolated unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from math import factorial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import lazy, reading
from lusee_bayes.core.arrays import Array, Values, namespace
from lusee_bayes.core.checks import Described, is_traced, listed
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.instrument.beams.fields import HemisphereGrid, Interpolation, Pairs, ProductBeams
from lusee_bayes.instrument.beams.sampled import read_beam
from lusee_bayes.instrument.beams.source import BeamSource, Circuit, Lines, Parameter, Receiver
from lusee_bayes.instrument.products import ports

Nodes = Float[np.ndarray, " nodes"]
# largest number of values for one polynomial; more values get cubic splines
MOST_IN_ONE = 5
WHAT = "a table of beam files: a column file, and one with two or more values for each parameter"


@dataclass(frozen=True, eq=False, repr=False)
class GridBeams(Described, BeamSource):
    """Beams interpolated between sources at the nodes of a grid of parameters.

    Attributes
    ----------
    path : str
        The table, for error messages.
    axes : mapping of str to (nodes,) array
        Increasing values of each parameter.
    sources : tuple of BeamSource
        For every combination of these values; the last parameter changes fastest.
    values : mapping of str to () array
        Present values of the parameters.
    nominal : mapping of str to float
        Values that define the conversion of visibilities from volts to K.
    cache : dict
        Results computed at the nodes.
    """

    path: str
    axes: Mapping[str, Nodes]
    sources: tuple[BeamSource, ...]
    values: Values
    nominal: Mapping[str, float]
    cache: dict[Any, np.ndarray] = field(default_factory=dict)

    def description(self) -> tuple[str, ...]:
        axes = (f"{name} {', '.join(f'{x:g}' for x in xs)}" for name, xs in self.axes.items())
        return f"{len(self.sources)} beam files, {self.n_ports} ports, over a grid of", *axes

    @property
    def n_ports(self) -> int:
        return self.sources[0].n_ports

    def parameters(self) -> dict[str, Parameter]:
        return {n: Parameter(self.values[n], xs[0], xs[-1]) for n, xs in self.axes.items()}

    def with_values(self, values: Values) -> GridBeams:
        for name, value in values.items():
            _, low, high = self.parameter(name)
            if not is_traced(value) and not low <= value <= high:
                raise InputError(
                    f"{self.path}: {name} is {float(value):.6g}, but the files cover {low:g} to "
                    f"{high:g}; give a value in this range, or files that cover it"
                )
        return replace(self, values={**self.values, **values})

    def weights(self, values: Values) -> Float[Array, " sources"]:
        """Return the weights of the sources for these values of all parameters."""
        combined = np.ones(1)
        for name, nodes in self.axes.items():
            combined = (combined[:, None] * weights_along(nodes, values[name])[None]).reshape(-1)
        return combined

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        return ProductBeams(self._seen(frequency_mhz, lmax)[:, :-1], float(frequency_mhz))

    def background(self, frequency_mhz: float) -> Float[Array, " products"]:
        return self._seen(frequency_mhz, 0)[:, -1]

    def _seen(self, frequency_mhz: float, lmax: int) -> Float[Array, "products columns"]:
        """Coefficients of the beams, and the visibilities without any sky."""
        nodes = self._at_nodes(frequency_mhz, lmax)
        return (self.weights(self.values) @ nodes.reshape(len(nodes), -1)).reshape(nodes.shape[1:])

    def _at_nodes(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, "sources products n"]:
        """The same for every source, in the unit of the nominal values."""
        key = frequency_mhz, lmax
        if key not in self.cache:
            unit = self.circuit(frequency_mhz)
            self.cache[key] = np.stack([_in_unit(source, unit, *key) for source in self.sources])
        return self.cache[key]

    def circuit(self, frequency_mhz: float) -> Circuit | None:
        """Return antennas and receivers at the nominal values, which define 1 K."""
        circuits = [source.circuit(frequency_mhz) for source in self.sources]
        if None in circuits:
            return None
        weights, names = self.weights(self.nominal), ("antenna_ohm", "moon_ohm", "loss_ohm")
        parts = {n: np.tensordot(weights, [getattr(c, n) for c in circuits], 1) for n in names}
        return replace(circuits[0], **parts)

    has_fields = False

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> Any:
        raise InputError(f"{self.path}: only product beams are interpolated, not E fields")

    def patterns(self, frequency_mhz: float, grid: HemisphereGrid) -> Pairs:
        each = [np.asarray(source.patterns(frequency_mhz, grid)) for source in self.sources]
        return np.tensordot(self.weights(self.values), each, 1)

    def interpolated(self, frequency_mhz: float) -> Interpolation | None:
        return self.sources[0].interpolated(frequency_mhz)

    def behind(self, receiver: Receiver | None) -> GridBeams:
        return replace(self, sources=tuple(s.behind(receiver) for s in self.sources), cache={})

    def interpolation_errors(self, frequency_mhz: float, lmax: int) -> dict[str, Lines]:
        """Return errors of beams that are interpolated without their own file.

        For each inner value of a parameter: the beams interpolated along this parameter from its
        other values, minus those of the files. This usually exceeds the error of the whole grid,
        whose polynomials have one degree more, or half the step; with three values it may be half.
        """
        nodes, errors = self._at_nodes(frequency_mhz, lmax)[..., :-1], {}
        whole = nodes.reshape(*map(len, self.axes.values()), *nodes.shape[1:])
        for number, (name, xs) in enumerate(self.axes.items()):
            along = np.moveaxis(whole, number, 0)
            for k in range(1, len(xs) - 1):
                weights = weights_along(np.delete(xs, k), xs[k])
                off = np.tensordot(weights, np.delete(along, k, 0), 1) - along[k]
                errors[f"{name} {xs[k]:g}"] = off.reshape(-1, *nodes.shape[1:])
        return errors


def _in_unit(source: BeamSource, unit: Circuit | None, frequency_mhz: float, lmax: int):
    """A source's coefficients and background, with 1 K as defined by another circuit."""
    modes, ground = source.beams(frequency_mhz, lmax).modes, source.background(frequency_mhz)
    both = np.concatenate([np.asarray(modes), np.asarray(ground)[:, None]], axis=1)
    if unit is None:
        return both
    ours, other = (c.per_kelvin.diagonal().real for c in (source.circuit(frequency_mhz), unit))
    first, second, _ = ports(source.n_ports)
    return both * np.sqrt((ours / other)[first] * (ours / other)[second])[:, None]


def weights_along(nodes: Nodes, value: float | Float[Array, ""]) -> Float[Array, " nodes"]:
    """Return the weights of values at nodes that interpolate them to a point.

    Parameters
    ----------
    nodes : (nodes,) array
        Increasing, at least two.
    value : () array
        The point, between the first and the last node.

    Returns
    -------
    (nodes,) array
        Differentiable in ``value``, twice if there are more than five nodes.
    """
    n, xp = len(nodes), namespace(value)
    degree = n - 1 if n <= MOST_IN_ONE else 3
    spline = lazy.interpolate.make_interp_spline(nodes, np.eye(n), k=degree)
    starts = np.unique(spline.t)[:-1]
    # Taylor coefficients of every weight, at the start of every piece
    taylor = np.stack([spline(starts, nu=d) / factorial(d) for d in range(degree + 1)], axis=1)
    piece = xp.searchsorted(xp.asarray(starts[1:]), value, side="right")
    step, terms = value - xp.asarray(starts)[piece], xp.asarray(taylor)[piece]
    return sum(step**d * terms[d] for d in range(degree + 1))


def read_beam_grid(
    path: str | Path,
    values: Mapping[str, float] | None = None,
    read: Callable[[str], BeamSource] = read_beam,
) -> GridBeams:
    """Read a table of beam files over a grid of parameters, and the files.

    Parameters
    ----------
    path : str or Path
    values : mapping of float, optional
        Values of parameters; by default the middle of the grid.
    read : callable
        Reads the beams of a file.

    Returns
    -------
    GridBeams

    Raises
    ------
    InputError
        As :func:`read_grid_table`; for unknown parameters, values outside the grid, and files that
        cannot be read.
    """
    files, axes = read_grid_table(path)
    middle = {name: float(xs[0] + xs[-1]) / 2.0 for name, xs in axes.items()}
    sources = tuple(map(read, files))
    if len(ports_of := {source.n_ports for source in sources}) > 1:
        raise InputError(f"{path}: the files have {listed(ports_of)} ports; expected one number")
    grid = GridBeams(str(path), axes, sources, middle, middle)
    grid = grid.with_values(values or {})
    return replace(grid, nominal=grid.values)


def read_grid_table(path: str | Path) -> tuple[tuple[str, ...], dict[str, Nodes]]:
    """Read the names of files over a grid, the last parameter changing fastest, and its axes.

    Raises
    ------
    InputError
        If the table is missing or damaged, lacks a combination of values, or has one twice.
    """
    columns = reading.read_table(path, Layout(WHAT, {"file": Variable(("row",), "text")}))
    names = [name for name in columns if name != "file"]
    layout = Layout(WHAT, dict.fromkeys(names, Variable(("row",))))
    numbers = layout.checked(path, {name: columns[name] for name in names}, {}).arrays
    axes = {name: np.unique(column) for name, column in numbers.items()}
    if min(map(len, axes.values()), default=0) < 2:
        raise InputError(f"{path} has a parameter of one value, or none; expected {WHAT}")
    rows, places = list(zip(*numbers.values(), strict=True)), list(product(*axes.values()))
    for place in places:
        if rows.count(place) != 1:
            said = ", ".join(f"{name} {x:g}" for name, x in zip(axes, place, strict=True))
            raise InputError(
                f"{path} has {rows.count(place) or 'no'} files for {said}; expected one file for "
                "every combination of the parameters' values"
            )
    files = (columns["file"][rows.index(place)] for place in places)
    return tuple(str(Path(path).parent / file) for file in files), axes
