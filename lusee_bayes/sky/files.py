"""What a reader of sky files must offer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import map_to_modes


class SkyFile(ABC):
    """The content of one file of sky maps or coefficients, whole and checked.

    A new layout of files is a subclass, and one entry in
    :data:`lusee_bayes.sky.source.SKY_READERS`.
    """

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Tell whether an existing file has this layout.

        Raises
        ------
        InputError
            If finding out needs more of the file than can be read.
        """

    @classmethod
    @abstractmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyFile:
        """Read a file of this layout.

        Parameters
        ----------
        path : str or Path
            The file.
        dataset : str, optional
            Which of its data sets to read, for layouts that have several.

        Raises
        ------
        InputError
            If the file cannot be used. The message says what is wrong and how to mend it.
        """

    @abstractmethod
    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        """Compute the sky's coefficients at a frequency.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz. Layouts that do not say their frequency return the same sky at all.
        lmax : int
            Highest ell.

        Returns
        -------
        (modes,) array
            Real packed coefficients, Galactic, in K.

        Raises
        ------
        InputError
            If the file holds no sky at this frequency, or not up to this ell.
        """

    @abstractmethod
    def summary(self) -> tuple[str, ...]:
        """Say in a few lines what the file holds."""


def modes_of_map(
    path: str | Path, pixels: Float[np.ndarray, " pixels"], lmax: int
) -> Float[np.ndarray, " modes"]:
    """Coefficients of a file's map; an InputError names the file."""
    try:
        return map_to_modes(pixels, lmax)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
