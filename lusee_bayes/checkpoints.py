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

from lusee_bayes.checks import AnyArray, InputError

IDENTITY = "run.json"
CHUNK_GLOB = "chunk-*.npz"


@dataclass(frozen=True)
class Chunk:
    """What one file holds.

    iteration : iterations done at its end, warmup included; state : leaves of the sampler's state;
    draws : arrays (draws of the chunk, chains, ...) by name.
    """

    iteration: int
    state: list[np.ndarray]
    draws: dict[str, np.ndarray]

    def write(self, folder: Path) -> None:
        """Write the chunk's file, by way of a scratch file that replaces it in one step."""
        arrays = {f"state:{i:03d}": leaf for i, leaf in enumerate(self.state)}
        arrays |= {f"draws:{name}": values for name, values in self.draws.items()}
        target = folder / f"chunk-{self.iteration:08d}.npz"
        scratch = folder / f".partial-{target.name}"
        with scratch.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, target)

    @classmethod
    def read(cls, path: Path) -> Chunk:
        """InputError if the file cannot be read."""
        try:
            with np.load(path) as arrays:
                kinds = {"state": {}, "draws": {}}
                for key in arrays.files:
                    kind, name = key.split(":", 1)
                    kinds[kind][name] = arrays[key]
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise InputError(
                f"the checkpoint '{path}' cannot be read ({error}); delete it to go on from the "
                "one before"
            ) from error
        state = [kinds["state"][name] for name in sorted(kinds["state"])]
        return cls(int(path.stem.removeprefix("chunk-")), state, kinds["draws"])


class Checkpoints:
    """The chunks of one run in one folder."""

    def __init__(self, folder: str | Path, identity: dict[str, object], *, resume: bool):
        """Open ``folder`` for a run that is told from others by ``identity`` (JSON values).

        InputError if it holds an unfinished run and ``resume`` is False, or one that differs.
        """
        self.folder = Path(folder)
        described = json.loads(json.dumps(identity))
        marker = self.folder / IDENTITY
        if marker.exists():
            self._require_same(json.loads(marker.read_text()), described, resume)
        else:
            self.folder.mkdir(parents=True, exist_ok=True)
            scratch = self.folder / f".partial-{IDENTITY}"
            scratch.write_text(json.dumps(described, indent=2) + "\n")
            os.replace(scratch, marker)

    def _require_same(self, found: dict, described: dict, resume: bool) -> None:
        if not resume:
            chunks = self._paths()
            done = chunks[-1].stem.removeprefix("chunk-").lstrip("0") if chunks else "no"
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
        """Where to go on; None if nothing is done yet."""
        paths = self._paths()
        return Chunk.read(paths[-1]) if paths else None

    def append(self, iteration: int, state: list[AnyArray], draws: dict[str, AnyArray]) -> None:
        """Keep what was sampled since the last call."""
        arrays = {name: np.asarray(values) for name, values in draws.items()}
        Chunk(iteration, [np.asarray(leaf) for leaf in state], arrays).write(self.folder)

    def draws(self) -> dict[str, np.ndarray]:
        """All draws so far, (chains, draws, ...) by name."""
        chunks = [Chunk.read(path).draws for path in self._paths()]
        kept = [c for c in chunks if c]
        return {
            name: np.concatenate([c[name] for c in kept]).swapaxes(0, 1)
            for name in (kept[0] if kept else {})
        }

    def remove(self) -> None:
        """Delete the folder: its draws are kept elsewhere now."""
        shutil.rmtree(self.folder)


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
