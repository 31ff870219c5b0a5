"""A session of the spectrometer: data about every spectrum; the spectra stay in the file.

Facts of the spectrometer are from the flight software (lusee-night/coreloop: ``high_prec_avg.h``,
``core_loop.h``) and from luseepy's ``lusee.ingest``. ADCs of 14 bits take 102.4 million samples a
second, of which 4096 form a spectrum of 2048 channels, 25 kHz apart, every 40 microseconds.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped

from lusee_bayes.core import checks, formats
from lusee_bayes.core.arrays import Rows
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Content, Unread, Variable
from lusee_bayes.core.reading import reading
from lusee_bayes.flight.clock import Clock
from lusee_bayes.instrument.products import auto_indices, labels, ports

# data of each spectrum, and of each port of it; all channels; telemetry at the times of spectra
RowCounts = Int[np.ndarray, " rows"]
PortCounts = Int[np.ndarray, "rows ports"]
PortLevels = Shaped[np.ndarray, "rows ports"]
Middles = Float[np.ndarray, " channels"]
Telemetry = Mapping[str, Rows]

N_CHANNELS = 2048
CHANNEL_MHZ = 0.025
FRAME_S = 4096 / 102.4e6
# range of an ADC of 14 bits
ADC_LOW, ADC_HIGH = -8192, 8191
# gain states of the flight software (gain_state of core_loop.h) that are in the gain table
CODES = {"L": 0, "M": 1, "H": 2}
LETTERS = tuple(CODES)
NO_LEVEL = "-"
PORTS = 4

# autos of the four ports, then real and imaginary part of every pair
FLIGHT_PRODUCTS = tuple(sorted(labels(), key=lambda label: label[0] != label[1]))
N_PRODUCTS = len(FLIGHT_PRODUCTS)
# the package's products in the spectrometer's order, and the ports and part of each of them
OF_FLIGHT = np.array([FLIGHT_PRODUCTS.index(label) for label in labels()])
AUTOS = auto_indices()
FIRST_PORT, SECOND_PORT, IMAGINARY = ports()

BinOrigin = Literal["centre", "edge"]


@dataclass(frozen=True)
class Averaging:
    """The channels in a bin of a spectrum, for a value of ``Navgf``.

    Attributes
    ----------
    stride : int
        Bin i begins at channel stride * i; a sum is divided by it.
    members : int
        Number of channels that are summed, from there on.
    """

    stride: int
    members: int

    @property
    def n_bins(self) -> int:
        """Number of bins."""
        return N_CHANNELS // self.stride

    def channels(self) -> Int[np.ndarray, "bins members"]:
        """Return the channels of every bin."""
        return self.stride * np.arange(self.n_bins)[:, None] + np.arange(self.members)


# Navgf = 3 leaves out every fourth channel and divides the sum of three by four
AVERAGING = {1: Averaging(1, 1), 2: Averaging(2, 2), 3: Averaging(4, 3), 4: Averaging(4, 4)}


def channel_mhz(origin: BinOrigin) -> Middles:
    """Return the middle of every channel in MHz.

    Parameters
    ----------
    origin : {"centre", "edge"}
        Whether channel k has its centre or its lower edge at k times 25 kHz.
    """
    return CHANNEL_MHZ * (np.arange(N_CHANNELS) + (0.5 if origin == "edge" else 0.0))


# telemetry that the gain table needs
TELEMETRY = ("THERM_FPGA", "SPE_ADC0_T", "SPE_ADC1_T", "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C")
# counts of spectra [first:last] of all products and channels
Read = Callable[[int, int], Float32[np.ndarray, "rows products channels"]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """Data about the spectra of a session, read or to be written.

    Attributes
    ----------
    raw_s : (rows,) array
        Readings of the mission clock, in seconds.
    navgf : (rows,) array of int
        Averaging over channels (:data:`.AVERAGING`).
    navg_shift : (rows,) array of int
        Base-2 logarithm of the number of frames that a spectrum averages.
    level : (rows, ports) array of str
        Gain level: L, M, H, or "-" where the gain table has none.
    adc_low, adc_high : (rows, ports) array of int
        Extremes of the ADC.
    adc_invalid : (rows, ports) array of int
        Number of its samples that were out of range.
    telemetry : mapping of str to (rows,) array
        Some of :data:`TELEMETRY`, at the times of the spectra.
    clock : Clock or None
        None if the file does not specify the UTC of its clock.
    lon_deg, lat_deg : float
        Site according to the file.
    """

    raw_s: Rows
    navgf: RowCounts
    navg_shift: RowCounts
    level: PortLevels
    adc_low: PortCounts
    adc_high: PortCounts
    adc_invalid: PortCounts
    telemetry: Telemetry
    clock: Clock | None
    lon_deg: float
    lat_deg: float

    @property
    def n_rows(self) -> int:
        """Number of spectra."""
        return len(self.raw_s)


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class Session(checks.Described, Recorded):
    """A session; its spectra stay in the file.

    Attributes
    ----------
    path : Path
    layout : int
        Version of luseepy's layout.
    kind : str
        HDF5 or FITS.
    share : (rows,) array
        Share of the frames that was not rejected; 1 if the file lacks it.
    errors : (rows,) array of int
        Errors that the flight software reports.
    notch : (rows,) array of int or None
        Whether the average of every fourth channel is subtracted; None if the file lacks it.
    software : str
        Version of the flight software, such as 0x307.
    unused : mapping of str to int
        Other families of data in the file, and their numbers of rows.
    """

    path: Path
    layout: int
    kind: str
    share: Rows
    errors: RowCounts
    notch: RowCounts | None
    software: str
    unused: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self):
        if (back := np.flatnonzero(~(np.diff(self.raw_s) > 0.0))).size:
            k = int(back[0])
            raise InputError(
                f"{self.path}: spectrum {k + 1} (clock {self.raw_s[k + 1]:.6f} s) is not later "
                f"than spectrum {k} ({self.raw_s[k]:.6f} s); spectra must be in order of time"
            )
        for value in np.unique(self.navgf):
            if int(value) not in AVERAGING:
                valid = ", ".join(map(str, AVERAGING))
                raise InputError(f"{self.path}: Navgf is {value}; the flight software has {valid}")

    @property
    def frames(self) -> Rows:
        """Number of frames that each spectrum averages."""
        return self.share * 2.0**self.navg_shift

    @property
    def window_s(self) -> Rows:
        """Time from the start to the end of each integration, in seconds."""
        return FRAME_S * 2.0**self.navg_shift

    @property
    def saturated(self) -> Bool[np.ndarray, " rows"]:
        """Whether an ADC was at the end of its range, or beyond."""
        # some versions of the flight software count from -8191 or to 8192
        ends = (self.adc_low <= ADC_LOW + 1) | (self.adc_high >= ADC_HIGH)
        return (ends | (self.adc_invalid > 0)).any(axis=1)

    @property
    def notched(self) -> Bool[np.ndarray, " rows"]:
        """Whether the mean of the comb's channels is subtracted, according to the file."""
        if self.notch is None:
            return np.zeros(self.n_rows, dtype=bool)
        # bit 4 negates the others
        return ((self.notch & 0b111) > 0) & ((self.notch & 0b10000) == 0)

    @contextmanager
    def spectra(self) -> Iterator[Read]:
        """Open the file to read counts piece by piece.

        Raises
        ------
        InputError
            If the file is damaged where it is read.
        """
        with reading(self.path, "a session") as path, ExitStack() as stack:
            if self.kind == "FITS":
                cube = stack.enter_context(formats.opened(path, "a session"))["SPECTRA"].section
            else:
                with h5py.File(path) as file:
                    cache = cache_for(file["spectra/data"].chunks)
                cube = stack.enter_context(h5py.File(path, **cache))["spectra/data"]
            yield lambda first, last: np.asarray(cube[first:last], dtype=np.float32)

    def description(self) -> tuple[str, ...]:
        states = ["".join(row) for row in np.unique(self.level, axis=0)]
        clock = "the file does not specify the UTC of its clock"
        if self.clock is not None:
            ends = self.clock.utc(self.raw_s[[0, -1]])
            clock = f"{ends[0].isot[:19]} to {ends[1].isot[:19]} UTC, clock in {self.clock.scale}"
        averaged = ", ".join(map(str, np.unique(self.navgf)))
        lengths = dict.fromkeys((self.window_s.min(), self.window_s.max()))
        length = " to ".join(f"{length:.6g}" for length in lengths)
        notch = "unknown" if self.notch is None else f"{int((self.notch > 0).sum())} with it"
        lacking = [name for name in TELEMETRY if name not in self.telemetry]
        unused = [f"{name} ({checks.counted(n, 'row')})" for name, n in self.unused.items()]
        return (
            f"{self.n_rows} spectra of 16 products, {N_CHANNELS} channels, {self.kind} layout "
            f"{self.layout}, flight software {self.software}",
            clock,
            f"each integrated for {length} s; Navgf {averaged}; gains of the ports "
            f"{', '.join(states)}",
            f"site: longitude {self.lon_deg:g}, latitude {self.lat_deg:g} degrees",
            f"{int(self.saturated.sum())} spectra with a saturated ADC, "
            f"{int((self.errors != 0).sum())} with errors of the flight software, "
            f"{int((self.share < 1.0).sum())} partly averaged; notch: {notch}",
            "telemetry of the gain table: " + ("lacks " + ", ".join(lacking) if lacking else "all"),
            *(["not used: " + ", ".join(unused)] if unused else []),
        )


# luseepy lets h5py choose its chunks; for a long session one contains a thousand spectra of few
# channels. Unless all chunks of these spectra are cached, each is decompressed again for every slab
LARGEST_CACHE = 1 << 29
# far more places than chunks, so that two chunks do not compete for one
PLACES = 1_000_003


def cache_for(chunks: tuple[int, ...] | None) -> dict[str, Any]:
    """Return options of :class:`h5py.File` for reading spectra piece by piece.

    Parameters
    ----------
    chunks : (rows, products, channels) or None
        None for a dataset without chunks.
    """
    if chunks is None:
        return {}
    size = min(int(5.0 * chunks[0] * N_PRODUCTS * (N_CHANNELS + chunks[2])), LARGEST_CACHE)
    return {"rdcc_nbytes": max(size, 1 << 20), "rdcc_nslots": PLACES, "rdcc_w0": 1.0}


META = "spectra/metadata"
ADC_INVALID = (f"{META}/adc_invalid_count_min", f"{META}/adc_invalid_count_max")


def _counts(*more: int, low: float = -np.inf, high: float = np.inf, optional: bool = False):
    return Variable(("row", *more), "integer", low=low, high=high, optional=optional)


# fields common to all layouts, by the names of layout 3 in HDF5
ROWS = {
    "spectra/raw_times": Variable(("row",)),
    # NaN if the clock is unknown
    "spectra/mjd_times": Variable(("row",), finite=False, optional=True),
    f"{META}/Navgf": _counts(),
    **{f"{META}/Navg{k}_shift": _counts(low=0.0, high=40.0) for k in (1, 2)},
    f"{META}/actual_bitslice": _counts(16, low=0.0, high=31.0),
    **dict.fromkeys((f"{META}/adc_min", f"{META}/adc_max"), _counts(PORTS)),
    **dict.fromkeys(ADC_INVALID, _counts(PORTS, low=0.0, optional=True)),
    f"{META}/errors": _counts(optional=True),
    # only layout 4 has these two
    **dict.fromkeys((f"{META}/weight", f"{META}/notch"), _counts(low=0.0, optional=True)),
    **{f"telemetry/{name}": Variable(("row",), optional=True) for name in TELEMETRY},
}
SAID = {
    "constants.lun_lat_deg": Attribute(low=-90.0, high=90.0),
    "constants.lun_long_deg": Attribute(low=-360.0, high=360.0),
    "session_invariants.software_version": Attribute("word", optional=True),
    "spectra/data.units": Attribute("text", choices=("SDU",)),
    "spectra/data.representation": Attribute("text", choices=("gain_model_input_sdu",)),
    "spectra/data.bitslice_restored": Attribute("boolean"),
    "spectra/data.bitslice_reference": Attribute("integer", low=31.0, high=31.0),
    "spectra/data.normalization_version": Attribute("integer", low=1.0, high=1.0),
}


def session_of(path: Path, parsed: Content, arrays: Mapping[str, Unread], **others: Any) -> Session:
    """Create a session from the contents of a file.

    Parameters
    ----------
    path : Path
    parsed : Content
        Content with :data:`ROWS` and :data:`SAID`.
    arrays : mapping of str to array
        All arrays of the file, not yet read, by names as in :data:`ROWS`.
    **others
        Other attributes of :class:`Session`: layout, kind and clock.

    Raises
    ------
    InputError
        If counts or gains are invalid.
    """
    if not parsed.values["spectra/data.bitslice_restored"]:
        wrong = f"{path}: bit slices of spectra/data are not restored; ingest it again with luseepy"
        raise InputError(wrong)
    rows, cube = parsed.arrays, arrays["spectra/data"]
    n = parsed.sizes["row"]
    if tuple(cube.shape) != (n, 16, N_CHANNELS) or np.dtype(cube.dtype).kind != "f":
        raise InputError(
            f"{path}: spectra/data has shape {tuple(cube.shape)} and type {cube.dtype}, expected "
            f"({n}, 16, {N_CHANNELS}) real numbers"
        )
    none = np.zeros((n, PORTS), dtype=np.int64)
    said = parsed.values.get("session_invariants.software_version", "unknown")
    shift2 = rows[f"{META}/Navg2_shift"]
    averaged = 2.0**shift2
    return Session(
        path=path,
        raw_s=rows["spectra/raw_times"],
        navgf=rows[f"{META}/Navgf"],
        navg_shift=rows[f"{META}/Navg1_shift"] + shift2,
        share=np.minimum(rows.get(f"{META}/weight", averaged) / averaged, 1.0),
        level=_levels(path, arrays, n),
        adc_low=rows[f"{META}/adc_min"],
        adc_high=rows[f"{META}/adc_max"],
        adc_invalid=sum(rows.get(name, none) for name in ADC_INVALID),
        errors=rows.get(f"{META}/errors", none[:, 0]),
        notch=rows.get(f"{META}/notch"),
        telemetry={x: rows[name] for x in TELEMETRY if (name := f"telemetry/{x}") in rows},
        lon_deg=parsed.values["constants.lun_long_deg"],
        lat_deg=parsed.values["constants.lun_lat_deg"],
        # versions of the flight software are written in hexadecimal: 0x307 for the number 775
        software=f"{int(said):#x}" if said.isascii() and said.isdigit() else said,
        **others,
    )


def _levels(path: Path, arrays: Mapping[str, Unread], n: int) -> PortLevels:
    """Gain levels, from the flight software's numbers or from letters."""
    if (name := f"{META}/actual_gain") not in arrays:
        raise InputError(
            f"{path} has no {name}, the gain of every spectrum; ingest it with the current luseepy"
        )
    codes = np.asarray(arrays[name])
    if codes.dtype.kind == "S" and codes.shape == (n,):
        # FITS joins the letters of a row
        codes = np.array([list(row.decode().ljust(PORTS)) for row in codes], dtype="U1")
    if codes.shape != (n, PORTS) or codes.dtype.kind not in "iuSU":
        raise InputError(
            f"{path}: {name} has shape {codes.shape} and type {codes.dtype}, expected "
            f"({n}, {PORTS}) gain codes or letters"
        )
    if codes.dtype.kind in "iu":
        codes = np.select([codes == code for code in CODES.values()], LETTERS, NO_LEVEL)
    levels = codes.astype("U1")
    return np.where(np.isin(levels, LETTERS), levels, NO_LEVEL)
