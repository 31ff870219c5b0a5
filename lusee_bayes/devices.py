"""Where a run computes: the devices of a process, and what its processes do together."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lusee_bayes.checks import InputError, ProcessLost, require_float64

T = TypeVar("T")

# numbers that are added up at a time: 32 MB
SLAB = 1 << 22

# longest time that processes wait for the slowest of them
WEEK_MS = 7 * 24 * 3600 * 1000


def use_cpu_devices(n: int) -> None:
    """Make ``n`` devices of this process's CPU; to be called before anything is computed."""
    if n < 1:
        raise InputError(f"the number of CPU devices must be at least 1, got {n}")
    try:
        jax.config.update("jax_num_cpu_devices", n)
    except RuntimeError as error:
        have = len(jax.local_devices(backend="cpu"))
        if have != n:
            raise InputError(
                f"JAX has already started with {have} CPU device(s) in this process; ask for {n} "
                "before anything is computed"
            ) from error


@dataclass(frozen=True)
class Fleet:
    """The processes of a run, seen from process ``number`` of ``processes``.

    :meth:`barrier` and :meth:`total` have to be called by all of them, in the same order.
    """

    processes: int = 1
    number: int = 0
    _turns: Iterator[int] = field(default_factory=itertools.count, repr=False, compare=False)

    @property
    def is_first(self) -> bool:
        """True in the one process that writes and reports."""
        return self.number == 0

    def mine(self, items: Sequence[T]) -> list[T]:
        """The items that this process has to do: every ``processes``-th of them."""
        return list(items[self.number :: self.processes])

    def device_of(self, k: int) -> jax.Device:
        """The device of this process for the k-th of its items, in turn."""
        devices = jax.local_devices()
        return devices[k % len(devices)]

    def barrier(self, name: str) -> None:
        """Wait until every process has come to the barrier ``name``."""
        here = float(zlib.crc32(name.encode()))
        if self.total(np.array([here]))[0] != here * self.processes:
            raise RuntimeError(f"the processes of this run are out of step at '{name}'")

    def total(self, array: np.ndarray) -> np.ndarray:
        """The sum of the processes' float64 arrays, of one shape: bit by bit the same in each."""
        require_float64("array", array)
        result = np.array(array, order="C")
        if self.processes == 1:
            return result
        flat = result.reshape(-1)
        try:
            self._wait()
            for start in range(0, flat.size, SLAB):
                flat[start : start + SLAB] = self._sum(flat[start : start + SLAB])
        except jax.errors.JaxRuntimeError as error:
            raise ProcessLost(
                "another process of this run has ended; the same command goes on from what is "
                f"finished ({' '.join(str(error).split())[:200]})"
            ) from error
        return result

    def _wait(self) -> None:
        """Wait for all, as long as it takes: JAX's own sums give up after half an hour."""
        # the one thing here that JAX does not promise to keep; without it, half an hour it is
        state = getattr(getattr(jax._src, "distributed", None), "global_state", None)
        client = getattr(state, "client", None)
        if client is not None:
            client.wait_at_barrier(f"lusee_bayes/{next(self._turns)}", WEEK_MS)

    def _sum(self, part: np.ndarray) -> np.ndarray:
        mesh, add = self._adder
        rows = NamedSharding(mesh, PartitionSpec("process"))
        mine = jax.device_put(part[None], mesh.devices[self.number])
        shape = (self.processes, *part.shape)
        whole = jax.make_array_from_single_device_arrays(shape, rows, [mine])
        return np.asarray(add(whole).addressable_data(0))

    @cached_property
    def _adder(self) -> tuple[Mesh, Callable]:
        """The first device of every process, and the sum over them."""
        first: dict[int, jax.Device] = {}
        for device in jax.devices():
            first.setdefault(device.process_index, device)
        mesh = Mesh(np.array([first[k] for k in range(self.processes)]), ("process",))
        everywhere = NamedSharding(mesh, PartitionSpec())
        return mesh, jax.jit(lambda rows: rows.sum(axis=0), out_shardings=everywhere)
