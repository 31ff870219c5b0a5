"""Skies by name or file, for a validation on real skies."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.paths import user_path
from lusee_bayes.sky import FileSource, GalaxySource, SkySource
from lusee_bayes.testing.skies import SmoothSky, SpottySky

# each takes a seed
NAMED: dict[str, Callable[[int], SkySource]] = {
    "embedded": lambda seed: GalaxySource(seed, ()),
    "embedded+sources": GalaxySource,
    "smooth": SmoothSky,
    "spotty": SpottySky,
}


@dataclass(frozen=True)
class GivenSky:
    """A sky that a validation maps.

    Attributes
    ----------
    name : str
        As in tables: NAME:SEED, or that of the file.
    source : SkySource
    digest : str
        Of the file's content; empty for a sky of a name.
    """

    name: str
    source: SkySource
    digest: str = ""


def given_skies(texts: Sequence[str | Path]) -> list[GivenSky]:
    """Find the skies.

    Parameters
    ----------
    texts : sequence of str or Path
        ``embedded`` (the diffuse Galaxy), ``embedded+sources``, ``smooth`` or ``spotty``, with
        ``:SEED`` if it is not 1; or a file of any layout that ``sky.file`` takes.

    Raises
    ------
    InputError
        For what is neither, a seed that is no whole number, and two skies of one name.
    """
    found = [_given(str(user_path(text))) for text in texts]
    names = [sky.name for sky in found]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"--skies names '{twice[0]}' twice; give each sky once")
    return found


def _given(text: str) -> GivenSky:
    name, colon, seed = text.partition(":")
    if name in NAMED and not os.path.exists(text):
        if colon and not (seed.isascii() and seed.isdigit() and len(seed) < 10):
            raise InputError(
                f"--skies names '{text}'; expected a whole number as the seed of {name}"
            )
        number = int(seed) if colon else 1
        return GivenSky(f"{name}:{number}", NAMED[name](number))
    if not os.path.isfile(text):
        raise InputError(
            f"--skies: no sky '{text}', neither a file nor a name; {nearest(name, NAMED)} "
            "(a name may have a seed: embedded:2)"
        )
    with open(text, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:12]
    return GivenSky(Path(text).stem, FileSource(str(Path(text).absolute())), digest)
