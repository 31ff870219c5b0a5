"""The devices of a process, and sums over the processes of a run."""

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

from lusee_bayes.core.checks import require_float64
from lusee_bayes.core.errors import InputError, ProcessLost

T = TypeVar("T")

# numbers that are added up at a time: 32 MB
SUM_SIZE = 1 << 22

# longest time that processes wait for the slowest one
WEEK_MS = 7 * 24 * 3600 * 1000


def use_cpu_devices(n: int) -> None:
    """Split the CPU of this process into ``n`` JAX devices, before anything is computed.

    Raises
    ------
    InputError
        If ``n`` is less than 1, or JAX has already started with another number.
    """
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
class ProcessGroup:
    """The processes of a run, seen from one of them.

    All of them have to call :meth:`barrier` and :meth:`total`, in the same order.

    Attributes
    ----------
    processes : int
        How many there are.
    number : int
        Which one this is, from 0.
    """

    processes: int = 1
    number: int = 0
    _barriers: Iterator[int] = field(default_factory=itertools.count, repr=False, compare=False)

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.number == 0

    def mine(self, items: Sequence[T]) -> list[T]:
        """Return the items that this process works on: every ``processes``-th."""
        return list(items[self.number :: self.processes])

    def device_of(self, k: int) -> jax.Device:
        """Return the device for the k-th item of this process; devices take turns."""
        devices = jax.local_devices()
        return devices[k % len(devices)]

    def barrier(self, name: str) -> None:
        """Wait until every process has reached the barrier ``name``.

        Raises
        ------
        ProcessLost
            If another process has ended.
        RuntimeError
            If another process is at a barrier of another name.
        """
        checksum = float(zlib.crc32(name.encode()))
        if self.total(np.array([checksum]))[0] != checksum * self.processes:
            raise RuntimeError(f"the processes of this run are out of step at '{name}'")

    def total(self, array: np.ndarray) -> np.ndarray:
        """Sum arrays over all processes.

        Parameters
        ----------
        array : array of float64
            Of one shape in all processes.

        Returns
        -------
        array
            The same in every process, bit by bit.

        Raises
        ------
        ProcessLost
            If another process has ended.
        """
        require_float64("array", array)
        result = np.array(array, order="C")
        if self.processes == 1:
            return result
        flat = result.reshape(-1)
        try:
            self._wait()
            for start in range(0, flat.size, SUM_SIZE):
                flat[start : start + SUM_SIZE] = self._sum(flat[start : start + SUM_SIZE])
        except jax.errors.JaxRuntimeError as error:
            raise ProcessLost(
                "another process of this run has ended; the same command continues from what is "
                f"finished ({' '.join(str(error).split())[:200]})"
            ) from error
        return result

    def _wait(self) -> None:
        """Wait for all processes: JAX's own sums give up after half an hour."""
        # a private part of JAX, which it may drop; without it sums give up after half an hour
        state = getattr(getattr(jax._src, "distributed", None), "global_state", None)
        client = getattr(state, "client", None)
        if client is not None:
            client.wait_at_barrier(f"lusee_bayes/{next(self._barriers)}", WEEK_MS)

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
