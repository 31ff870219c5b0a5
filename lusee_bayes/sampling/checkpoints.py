"""Draws on disk as they come: a run that is killed at any moment goes on where it stopped.

One file a chunk: the draws of that chunk and the state of the chains behind it, written whole or
not at all. The last file is the place to go on from; nothing else needs to be consistent with it.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import read_json, reading

IDENTITY_LAYOUT = Layout("the description of an unfinished run")
IDENTITY = "run.json"
CHUNK_GLOB = "chunk-*.npz"


@dataclass(frozen=True)
class Chunk:
    """The content of one file.

    Attributes
    ----------
    iteration : int
        Iterations done at its end, warmup included.
    state : list of array
        Leaves of the sampler's state.
    draws : dict of (draws, chains, ...) array
        Draws of the chunk by name.
    start : int
        Iterations done before it.
    """

    iteration: int
    state: list[np.ndarray]
    draws: dict[str, np.ndarray]
    start: int = 0

    def write(self, folder: Path) -> None:
        """Write the chunk's file whole or not at all."""
        arrays = {f"state:{i:03d}": leaf for i, leaf in enumerate(self.state)}
        arrays |= {f"draws:{name}": values for name, values in self.draws.items()}
        arrays["start:"] = np.array(self.start)
        target = folder / f"chunk-{self.iteration:08d}.npz"
        scratch = folder / f".partial-{target.name}"
        with scratch.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, target)

    @classmethod
    def read(cls, path: Path) -> Chunk:
        """Read a chunk's file. InputError if it cannot be read."""
        kinds: dict[str, dict[str, np.ndarray]] = {"start": {}, "state": {}, "draws": {}}
        try:
            with reading(path, "a checkpoint"), path.open("rb") as file, np.load(file) as arrays:
                for key in arrays.files:
                    kind, name = key.split(":", 1)
                    kinds[kind][name] = arrays[key]
                start = int(kinds["start"][""])
        except InputError as error:
            raise InputError(f"{error}; delete it to go on from the one before") from error
        state = [kinds["state"][name] for name in sorted(kinds["state"])]
        return cls(_iteration(path), state, kinds["draws"], start)


class Checkpoints:
    """The chunks of one run in one folder.

    Parameters
    ----------
    folder : str or Path
        The folder.
    identity : dict
        JSON values that tell the run from others.
    resume : bool
        Whether to go on with an unfinished run.

    Raises
    ------
    InputError
        If the folder holds an unfinished run and ``resume`` is False, or another run, or draws of
        an unknown one.
    """

    def __init__(self, folder: str | Path, identity: dict[str, object], *, resume: bool):
        self.folder = Path(folder)
        described = json.loads(json.dumps(identity))
        marker = self.folder / IDENTITY
        if marker.exists():
            self._require_same(_read_marker(marker), described, resume)
        elif self._paths():
            raise InputError(
                f"'{self.folder}' holds draws, but no {IDENTITY} that says of which run; delete "
                "the folder"
            )
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            scratch = self.folder / f".partial-{IDENTITY}"
            scratch.write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
            os.replace(scratch, marker)

    def _require_same(self, found: dict, described: dict, resume: bool) -> None:
        if not resume:
            chunks = self._paths()
            done = _iteration(chunks[-1]) if chunks else "no"
            raise InputError(
                f"'{self.folder}' holds an unfinished run ({done} iterations done); go on with "
                "--resume, or delete the folder"
            )
        for name in sorted({*found, *described}):
            if found.get(name) != described.get(name):
                raise InputError(
                    f"the unfinished run in '{self.folder}' has another {name}: "
                    f"{_short(found.get(name))}, now {_short(described.get(name))}; resume it with "
                    "the same, or delete the folder"
                )

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob(CHUNK_GLOB))

    def last(self) -> Chunk | None:
        """Return the last chunk; None if nothing is done yet."""
        paths = self._paths()
        return Chunk.read(paths[-1]) if paths else None

    def append(self, iteration: int, state: list[Array], draws: dict[str, Array]) -> None:
        """Keep what was sampled since the last call.

        Parameters
        ----------
        iteration : int
            Iterations done by now, warmup included.
        state : list of array
            Leaves of the sampler's state.
        draws : dict of (draws, chains, ...) array
            Draws since the last call by name.
        """
        paths = self._paths()
        start = _iteration(paths[-1]) if paths else 0
        arrays = {name: np.asarray(values) for name, values in draws.items()}
        Chunk(iteration, [np.asarray(leaf) for leaf in state], arrays, start).write(self.folder)

    def draws(self) -> dict[str, np.ndarray]:
        """Return all draws so far, (chains, draws, ...) by name.

        Raises
        ------
        InputError
            If a chunk is missing.
        """
        chunks = [Chunk.read(path) for path in self._paths()]
        done = 0
        for chunk in chunks:
            if chunk.start != done:
                raise InputError(
                    f"'{self.folder}' lacks the draws of iterations {done} to {chunk.start}; "
                    "delete the chunks behind them to go on from there"
                )
            done = chunk.iteration
        kept = [chunk.draws for chunk in chunks if chunk.draws]
        return {
            name: np.concatenate([c[name] for c in kept]).swapaxes(0, 1)
            for name in (kept[0] if kept else {})
        }

    def remove(self) -> None:
        """Delete the folder. If that is interrupted, no half of it is left under its name."""
        doomed = self.folder.with_name(f".{self.folder.name}-removed")
        shutil.rmtree(doomed, ignore_errors=True)
        if self.folder.exists():
            os.replace(self.folder, doomed)
            shutil.rmtree(doomed)


def _iteration(path: Path) -> int:
    return int(path.stem.removeprefix("chunk-"))


def _read_marker(marker: Path) -> dict[str, object]:
    try:
        return read_json(marker, IDENTITY_LAYOUT)
    except InputError as error:
        raise InputError(f"{error}; delete its folder") from error


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
