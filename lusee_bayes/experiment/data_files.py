"""Measured data of a scenario, from any supported file; sessions are reduced on reading."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import arrays, formats, trees
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import user_path
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming, parse_yaml, require_file
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.flight import flags, reduction, session_files
from lusee_bayes.flight.clock import read_clock
from lusee_bayes.flight.gain_model import GainModel, read_gain_table, synthetic_gains
from lusee_bayes.flight.recipe import FlightSection, Recipe
from lusee_bayes.flight.reduced import Reduced, read_reduced
from lusee_bayes.flight.session import PORTS
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.beams.fields import SAME_FREQUENCY_MHZ
from lusee_bayes.instrument.times import Timestamp
from lusee_bayes.instrument.visibilities import HINT, Visibilities, read_visibilities
from lusee_bayes.instrument.waterfalls import INTERPOLATIONS, Waterfall, read_waterfall

ACCEPTED = (
    "visibilities (lusee-bayes simulate), a waterfall of luseepy, sessions or reduced spectra"
)
# images that only luseepy's waterfalls have among FITS files
WATERFALL_IMAGES = {"combinations", "products"}

# settings by which sessions are reduced, except files, which may have moved
OF_REDUCTION = {
    "observation": {"timestamp", "average_s"},
    "flight": FlightSection.model_fields.keys()
    - {"gain_table", "clock", "lines", "per_kelvin_v2_hz", "leave_out", "simulated"},
}

# relative; beams and data store impedances with 24 bits
SAME_SCALE = 1e-5
# relative; a header stores 15 digits of a temperature
SAME_TEMPERATURE = 1e-12


# visibilities in memory, one set per frequency; a file of visibilities or of reduced spectra; or
# spectrometer sessions
Data = Visibilities | str | Path | Sequence[Visibilities] | Sequence[str | Path]


def items_of(data: object) -> tuple[Visibilities, ...] | tuple[Path, ...]:
    """The sets in memory, or the files that contain the data.

    Parameters
    ----------
    data : Data
        Or any other object that a user passes.

    Raises
    ------
    InputError
        If there are no data, another type, or both sets and files.
    """
    one = Visibilities | str | Path
    items = data if isinstance(data, Sequence) and not isinstance(data, str) else (data,)
    if wrong := [item for item in items if not isinstance(item, one)]:
        raise InputError(
            "data must be Visibilities, paths of files, or lists of either, not a "
            f"{type(wrong[0]).__name__}; use Visibilities.from_arrays for arrays"
        )
    sets = tuple(item for item in items if isinstance(item, Visibilities))
    if not items:
        raise InputError("got no data; give Visibilities or files")
    if len(sets) not in (0, len(items)):
        raise InputError("got data both in memory and in files; give one kind")
    return sets or tuple(user_path(path) for path in items)


def files_of(data: Data) -> tuple[Path, ...]:
    """The files that contain the data; none for visibilities in memory."""
    return tuple(item for item in items_of(data) if isinstance(item, Path))


def anchored(data: Data) -> tuple[Visibilities, ...] | tuple[Path, ...]:
    """The data, with absolute paths of files."""
    return tuple(path.absolute() for path in files_of(data)) or items_of(data)


def names_of_data(data: Data) -> tuple[str, ...]:
    """Paths of the files, or ``visibilities in memory``."""
    return tuple(map(str, files_of(data))) or ("visibilities in memory",)


def digest_of(data: Data) -> str:
    """Hash of the contents, independent of file names. InputError if a file is missing."""
    digests = []
    for item in items_of(data):
        if isinstance(item, Visibilities):
            digests.append(item.digest())
            continue
        with require_file(item, "data", HINT).open("rb") as file:
            digests.append(hashlib.file_digest(file, "sha256").hexdigest())
    if len(digests) == 1:
        return digests[0]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def are_sessions(data: Data) -> bool:
    """Whether data are spectrometer sessions.

    Raises
    ------
    InputError
        If several files are neither sessions nor visibilities.
    """
    files = files_of(data)
    sessions = [formats.is_session(require_file(path, "data", HINT)) for path in files]
    ours = [formats.format_of(path) == formats.VISIBILITIES for path in files]
    alike = sessions if any(sessions) else ours
    if len(files) > 1 and not all(alike):
        raise InputError(
            f"'{files[alike.index(False)]}' differs from the other files: several must all be "
            "sessions of a spectrometer, or all visibilities of one frequency each"
        )
    return bool(files) and all(sessions)


def reduced_of(data: Data, scenario: Scenario, stages: Stages | None = None) -> Reduced | None:
    """Reduced spectra, read from a file or computed from sessions; None for other data.

    Raises
    ------
    InputError
        As in :func:`.reduce_files` and :func:`.read_reduced`.
    """
    files = files_of(data)
    if are_sessions(data):
        return reduce_files(files, scenario, stages)
    if not files or formats.format_of(files[0]) != formats.REDUCED:
        return None
    _require_same_reduction(files[0], scenario)
    return read_reduced(files[0])


def _require_same_reduction(path: Path, scenario: Scenario) -> None:
    """Raise InputError for settings, other than the defaults, that differ from a reduction's."""
    with trees.opened_tree(path, formats.REDUCED, "reduced spectra", HINT) as tree:
        made = parse_yaml(str(tree.attrs.get("scenario", "")), f"{path}: its scenario") or {}
    whole = scenario.model_dump(mode="json", exclude_defaults=True)
    for section, keys in OF_REDUCTION.items():
        given = whole.get(section) or {}
        for key in sorted(keys & given.keys()):
            if (said := made.get(section, given).get(key, given[key])) != given[key]:
                raise InputError(
                    f"{path} was reduced with {section}.{key}={said}, not {given[key]} as in the "
                    f"scenario; reduce the sessions again, or remove {section}.{key}"
                )


def read_data(data: Data, scenario: Scenario) -> Visibilities:
    """Read visibilities: the package's own files, a channel of luseepy's waterfalls, or sessions.

    Parameters
    ----------
    data : Visibilities, path, or sequence of them
        Visibilities in memory (the set at the scenario's frequency is used), a file, or
        spectrometer sessions, which are reduced.
    scenario : Scenario
        Sets the frequency to read, the instrument that a waterfall must match, the meaning of the
        times if a file does not specify it, and the time to average over.

    Raises
    ------
    InputError
        If the file cannot be used, the meaning of its times is unknown or contradictory, data
        cannot be averaged, or a waterfall does not match the scenario's beams.
    """
    if (reduced := reduced_of(data, scenario)) is not None:
        return visibilities_of(reduced, scenario)
    files, timestamp = files_of(data), scenario.observation.timestamp
    path = files[0] if files else "the data"
    if not files or not _is_waterfall(path):
        data = _nearest(items_of(data), scenario.frequency_mhz)
        if files:
            path, data = data, read_visibilities(data)
        data = _stamped(path, data, timestamp)
    else:
        waterfall = read_waterfall(path)
        data = waterfall.at(scenario.frequency_mhz, scenario.beam.source().n_ports)
        if waterfall.per_kelvin is not None:
            _require_same_instrument(waterfall, scenario)
        # samples of luseepy's simulators are instants; its format cannot declare windows
        if timestamp is not None:
            with naming(path):
                data = data.stamped(timestamp)
    if scenario.observation.average_s is None:
        return data
    with naming(path):
        return averaged(data, scenario.observation.average_s)


def _is_waterfall(path: Path) -> bool:
    """Whether a file is a luseepy waterfall, not our visibilities. InputError if neither."""
    kind, is_waterfall = formats.format_of(path), formats.is_fits(path)
    is_data = kind == formats.VISIBILITIES
    if is_waterfall:
        is_data = bool(WATERFALL_IMAGES & set(formats.image_names(path)))
    if not is_data:
        said = f" (its format is '{kind}')" if kind else ""
        raise InputError(f"{path} contains no data to map{said}; give {ACCEPTED}")
    return is_waterfall


def _nearest(sets: Sequence[arrays.T], frequency_mhz: float) -> arrays.T:
    """The only set or file, or that at a frequency. InputError if there is none, or several."""
    if len(sets) == 1:
        return sets[0]
    each = [x.frequency_mhz if isinstance(x, Visibilities) else _frequency_of(x) for x in sets]
    near = [k for k, mhz in enumerate(each) if abs(mhz - frequency_mhz) <= SAME_FREQUENCY_MHZ]
    if len(near) != 1:
        mhz = ", ".join(f"{mhz:.9g}" for mhz in each)
        raise InputError(
            f"the data are at {mhz} MHz, {len(near) or 'none'} of them at {frequency_mhz:.15g} "
            "MHz; give one set of each frequency, and add more with map --add"
        )
    return sets[near[0]]


def _frequency_of(path: Path) -> float:
    """The frequency of a file of visibilities, in MHz; the rest of the file is not read."""
    with trees.opened_tree(path, formats.VISIBILITIES, "data", HINT) as tree:
        return float(tree.attrs.get("frequency_mhz", np.nan))


def _stamped(path: str | Path, data: Visibilities, timestamp: Timestamp | None) -> Visibilities:
    """Give the times the meaning stated by the data, or otherwise by the scenario."""
    if not data.says_window:
        if timestamp is None:
            raise InputError(
                f"{path} does not say what its times mean: no time_bounds, no window = 'instant'; "
                "use --set observation.timestamp=start (or middle, end, instant)"
            )
        with naming(path):
            return data.stamped(timestamp)
    instants = data.observation.windows is None
    if timestamp not in (None, "instant" if instants else "middle"):
        said = "instants" if instants else "means over windows, with their start and end"
        raise InputError(
            f"{path} declares its samples {said}, but the scenario has "
            f"observation.timestamp={timestamp}; remove that, or correct the file"
        )
    return data


def _require_same_instrument(waterfall: Waterfall, scenario: Scenario) -> None:
    """Raise InputError unless data in V^2/Hz match these antennas, receivers and temperatures."""
    section, frequency = scenario.beam, scenario.frequency_mhz
    source = section.source().behind(waterfall.receiver)
    if (circuit := source.circuit(frequency)) is None:
        why = f"{waterfall.path} is in V^2/Hz, at receivers' inputs; give the response as beam.file"
        raise InputError(why)
    rule, said = source.interpolated(frequency), waterfall.interpolation
    if rule is not None and said is not None and said != INTERPOLATIONS[rule]:
        remedies = {w: f"use --set beam.interpolation={name}" for name, w in INTERPOLATIONS.items()}
        other = f"expected one of {', '.join(remedies)}, or a response that includes it"
        what_to_do = remedies.get(said, other)
        raise InputError(
            f"{section.file} does not contain the frequency {frequency:.15g} MHz; {waterfall.path} "
            f"uses FREQINT = '{said}', the scenario by beam.interpolation={rule}; {what_to_do}"
        )
    theirs = waterfall.per_kelvin[waterfall.channel(frequency)]
    ours = circuit.per_kelvin.diagonal().real
    port = int(np.argmax(np.abs(theirs / ours - 1.0)))
    if abs(theirs[port] / ours[port] - 1.0) > SAME_SCALE:
        if waterfall.receiver is None:
            what_to_do = "give the response and the beam.receiver of the data"
        elif section.receiver is not None:
            what_to_do = "remove beam.receiver to use the loads ZL in the data"
        else:
            what_to_do = "give the response of the data, which contain the loads ZL"
        raise InputError(
            f"in {waterfall.path} 1 K is {theirs[port]:.6g} V^2/Hz at port {port}, with "
            f"{section.file} it is {ours[port]:.6g}; {what_to_do}"
        )
    said_k = {"moon_temperature_k": waterfall.moon_k, "antenna_temperature_k": waterfall.antenna_k}
    for name, theirs_k in said_k.items():
        ours_k = getattr(section, name)
        if not np.isclose(theirs_k, ours_k, rtol=SAME_TEMPERATURE, atol=0.0):
            raise InputError(
                f"{waterfall.path} includes emission at {theirs_k:.15g} K, the scenario's {name} "
                f"is {ours_k:.15g}; use --set beam.{name}={theirs_k:.15g}"
            )


def reduce_files(
    paths: Sequence[str | Path], scenario: Scenario, stages: Stages | None = None
) -> Reduced:
    """Reduce sessions to the scenario's frequencies.

    Parameters
    ----------
    paths : sequence of paths
        HDF5 or FITS files of luseepy's ``lusee.ingest``, in any order.
    scenario : Scenario
    stages : Stages, optional
        Shows the progress.

    Raises
    ------
    InputError
        If the scenario does not supply what the files lack, a file is listed twice or already
        reduced, or as in :func:`.read_session` and :func:`.reduce_sessions`.
    """
    stages, paths = stages or Stages(), [user_path(path) for path in paths]
    resolved = [path.resolve() for path in paths]
    for k, path in enumerate(resolved):
        if path in resolved[:k]:
            raise InputError(f"'{paths[k]}' is listed twice; list every session once")
        if formats.format_of(path) == formats.REDUCED:
            raise InputError(f"'{paths[k]}' is reduced already; give it to lusee-bayes map --data")
    recipe = recipe_of(scenario)
    with stages("sessions"):
        sessions = [session_files.read_session(path) for path in paths]
    return reduction.reduce_sessions(sessions, recipe, stages)


def recipe_of(scenario: Scenario) -> Recipe:
    """The recipe by which a scenario reduces sessions.

    Raises
    ------
    InputError
        If it does not supply what the files lack: gains, bin origin, meaning of the times.
    """
    if (section := scenario.flight) is None:
        raise InputError(
            "the scenario has no section flight for sessions of the spectrometer; add one, or "
            "--set 'flight={gain_table: ..., bin_origin: centre}' (docs/howto/first_light.md)"
        )
    if section.gain_table is None:
        raise InputError(
            "the sessions contain counts, but the scenario has no gain table; use --set "
            "flight.gain_table=... (the folder of luseepy's gain model, or a netCDF file)"
        )
    if section.bin_origin is None:
        raise InputError(
            "the scenario must specify whether k times 25 kHz is the centre or the lower edge of "
            "channel k; use --set flight.bin_origin=centre (luseepy's labels) or edge"
        )
    if (timestamp := scenario.observation.timestamp) is None:
        raise InputError(
            "the sessions do not specify whether times are the start, middle or end of "
            "integrations; use --set observation.timestamp=middle (or start, end, instant)"
        )
    observation = scenario.observation
    frequencies = scenario.frequencies_mhz or (scenario.frequency_mhz,)
    parts = section, gain_table_of(section), timestamp, frequencies, observation.average_s
    lines = () if section.lines is None else flags.read_lines(section.lines)
    clock = None if section.clock is None else read_clock(section.clock)
    site = (observation.lon_deg, observation.lat_deg) if section.site == "scenario" else None
    return Recipe(*parts, lines, clock, site)


def visibilities_of(reduced: Reduced, scenario: Scenario) -> Visibilities:
    """One band of reduced spectra, converted to K with the scenario's beams.

    Raises
    ------
    InputError
        If there is no such band, no data remain in it, or the beams are not calibrated in volts.
    """
    return reduced.at(scenario.frequency_mhz, per_kelvin_of(scenario))


def per_kelvin_of(scenario: Scenario) -> Float[np.ndarray, " ports"]:
    """Power in V^2/Hz that an enclosure at 1 K produces at each port.

    Raises
    ------
    InputError
        If neither the beams nor the scenario specify it, or both do.
    """
    said = None if scenario.flight is None else scenario.flight.per_kelvin_v2_hz
    source = scenario.beam.source()
    if source.n_ports != PORTS:
        why = f"sessions have products of {PORTS} ports, the beams {source.n_ports}; give all beams"
        raise InputError(why)
    circuit = source.circuit(scenario.frequency_mhz)
    if circuit is None and said is None:
        raise InputError(
            "flight data are in V^2/Hz, at the receivers' inputs, but these beams are not "
            "calibrated in volts; give luseepy's four-port response as beam.file "
            "(beam.model=response), or the power of 1 K: --set flight.per_kelvin_v2_hz=..."
        )
    if circuit is not None and said is not None:
        why = "flight.per_kelvin_v2_hz is for beams without impedances, which these have; remove it"
        raise InputError(why)
    if circuit is None:
        return np.full(source.n_ports, float(said))
    return np.ascontiguousarray(circuit.per_kelvin.diagonal().real)


def gain_table_of(section: FlightSection) -> GainModel:
    """The gain table that a scenario names, or a synthetic one, with the scenario's errors.

    Raises
    ------
    InputError
        If the table cannot be read, or both table and scenario give the errors of its components.
    """
    path = section.gain_table
    table = synthetic_gains() if path is None else read_gain_table(path, section.gain_model)
    return table.with_component_std(section.component_std)
