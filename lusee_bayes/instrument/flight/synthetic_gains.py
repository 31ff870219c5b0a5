"""A gain table that is made up: smooth, like luseepy's in size, and all of it known.

Levels are 17 dB apart, as the measured ones; ports differ by some per cent; the two components are
a change of the whole gain and one of its slope, and telemetry moves them by some tenths of a per
cent.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.instrument.flight.gain_table import LETTERS, N_COMPONENTS, N_TERMS, GainTable
from lusee_bayes.instrument.flight.spectrometer import PORTS

MEAN = {"L": 7e-4, "M": 3e-2, "H": 1.5}
ANCHORS_MHZ = np.array([0.1, 0.7, 1.1, 3.1, *np.linspace(7.1, 70.1, 12)])
# what q_1 and q_2 have of each feature of the telemetry: 1, F, A, V, D, I, F^2, A^2, F A
TERMS = np.array(
    [
        [0.0, 2e-4, 1e-4, 1e-2, 1e-2, 5e-2, 1e-6, 1e-6, 0.0],
        [1e-3, 1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0, 1e-6, -1e-6],
    ]
)
# the gain falls towards the ends of the band
LOW_MHZ, HIGH_MHZ = 0.2, 80.0


def synthetic_gains(path: str = "made up") -> GainTable:
    """Return the table.

    Parameters
    ----------
    path : str
        Where it will be, for messages.
    """
    lead = (len(LETTERS), PORTS)
    f = ANCHORS_MHZ
    shape = (f / (f + LOW_MHZ)) ** 2 / (1.0 + (f / HIGH_MHZ) ** 2)
    ports = 1.0 + 0.04 * np.arange(PORTS)
    mean: Float[np.ndarray, "levels ports anchors"] = (
        np.array([MEAN[level] for level in LETTERS])[:, None, None] * ports[:, None] * shape
    )
    slope = np.log(f / 20.0) / 5.0
    component = np.stack([mean, mean * slope], axis=2)
    # every level and port has a law of its own
    factor = 1.0 + 0.1 * np.arange(len(LETTERS) * PORTS).reshape(*lead, 1, 1)
    coefficient = np.broadcast_to(TERMS, (*lead, N_COMPONENTS, N_TERMS)) * factor
    return GainTable(path, np.broadcast_to(f, (*lead, len(f))).copy(), mean, component, coefficient)
