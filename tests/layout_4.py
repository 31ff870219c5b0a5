"""A small session of layout 4, by hand: what luseepy's ``lusee.ingest.hdf5_writer`` makes of rows.

Fields of the metadata are unions of variants (one here, of all rows), times are seconds of the
spectrometer's clock, and telemetry is on the clock of the DCB, in seconds and 65536ths.
"""

import h5py
import numpy as np

N = 5
# seconds of the spectrometer's clock, with fractions that are ticks
RAW_S = 2.3e7 + 0.75 + 42.0 * np.arange(N)
# both clocks at the landing
SPECTROMETER_S, DCB_S = 1000.0, 900.0
LANDING = "2026-06-01T00:00:00"
# the flight software's codes: 0, 1, 2 are L, M, H; ports change after the second spectrum
GAINS = np.array([[1, 1, 1, 1]] * 2 + [[0, 1, 2, 0]] * 3, dtype=np.uint8)
SHIFTS = 14, 6
# of 64 averages by software; one spectrum has fewer
WEIGHT = np.array([64, 64, 48, 64, 64])
NOTCH = np.array([0, 0, 3, 0, 0])
NAMES = ["VMON_6V", "THERM_FPGA", "SPE_ADC0_T", "SPE_ADC1_T"]
NAMES += ["SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C"]


def counts():
    return np.random.default_rng(6).normal(size=(N, 16, 2048)).astype(np.float32)


def telemetry(name, spectrometer_s):
    """A straight line in time, of each quantity its own."""
    k = NAMES.index(name)
    return 1.0 + k + 1e-3 * (k + 1) * (spectrometer_s - RAW_S[0])


def metadata():
    """What every spectrum says of itself, in luseepy's types."""
    adc = np.arange(4 * N).reshape(N, 4)
    return {
        "navgf": np.full(N, 2),
        "navg1_shift": np.full(N, SHIFTS[0]),
        "navg2_shift": np.full(N, SHIFTS[1]),
        "weight": WEIGHT,
        "notch": NOTCH,
        "errors": np.array([0, 0, 0, 4, 0]),
        "actual_gain": GAINS,
        "actual_bitslice": np.full((N, 16), 20, dtype=np.uint8),
        "adc_min": -100 - adc,
        "adc_max": 200 + adc,
        "adc_invalid_count_min": np.zeros((N, 4), dtype=np.int64),
        "adc_invalid_count_max": adc,
    }


def write_layout_4(path):
    with h5py.File(path, "w") as file:
        file.attrs.update(layout_version=np.uint16(4), quality_status="clean")
        invariants = file.create_group("session_invariants").attrs
        invariants.update(software_version=np.uint32(0x307), software_version_valid=True)
        constants = file.create_group("constants").attrs
        constants.update(lun_lat_deg=-23.814, lun_long_deg=182.258, lun_height_m=0.0)
        clock = file.create_group("clock_reference")
        clock.attrs.update(available=np.bool_(True), format_version=np.uint16(1))
        clock.attrs.update(clock_reference_isot=LANDING, time_scale="utc", source="a record")
        clock["clock_sources"] = ["dcb", "spectrometer"]
        clock["clock_reference_raw_seconds"] = [DCB_S, SPECTROMETER_S]
        write_rows(file.create_group("spectra"), RAW_S)
        spectra = file["spectra"]
        spectra["navgf"] = np.full(N, 2, dtype=np.uint8)
        spectra["data"] = counts()
        about = spectra["data"].attrs
        about.update(units="SDU", representation="gain_model_input_sdu")
        about.update(bitslice_restored=np.bool_(True), bitslice_reference=np.uint8(31))
        about["normalization_version"] = np.uint16(1)
        for name, values in metadata().items():
            spectra[f"metadata/field_present/{name}"] = np.ones(N, dtype=bool)
            field = spectra.create_group(f"metadata/fields/{name}")
            field.attrs.update(kind="array_variants", variant_count=np.uint32(1))
            field["variant_index"] = np.zeros(N, dtype=np.int32)
            field["variant_000/row_indices"] = np.arange(N, dtype=np.uint64)
            field["variant_000/data"] = values
        write_telemetry(file.create_group("telemetry"))
    return path


def write_rows(group, raw_s):
    """What rows of every family have."""
    n = len(raw_s)
    group.attrs["count"] = np.uint64(n)
    group["unique_ids"] = np.arange(n, dtype=np.uint32)
    group["raw_seconds"] = raw_s
    group["raw_time_valid"] = np.ones(n, dtype=bool)
    group["original_indices"] = np.arange(n, dtype=np.uint64)


def write_telemetry(group):
    """Every 10 s, from before the first spectrum to after the last."""
    spectrometer_s = np.arange(RAW_S[0] - 15.0, RAW_S[-1] + 16.0, 10.0)
    dcb_s = spectrometer_s - SPECTROMETER_S + DCB_S
    group.attrs["source_kind"] = "b01_0x314"
    group["field_names"] = NAMES
    group["mission_seconds"] = np.floor(dcb_s).astype(np.uint32)
    group["lusee_subsecs"] = (65536 * (dcb_s % 1.0)).astype(np.uint16)
    group["values"] = np.stack([telemetry(name, spectrometer_s) for name in NAMES], axis=1)
    group["valid"] = np.ones(group["values"].shape, dtype=bool)


def write_families(path, **n_rows):
    """Other families of data, by their groups, with so many rows."""
    with h5py.File(path, "a") as file:
        for name, n in n_rows.items():
            write_rows(file.create_group(name.replace("__", "/")), RAW_S[0] + np.arange(n))
    return path
