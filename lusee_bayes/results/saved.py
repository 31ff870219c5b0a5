"""What finished runs have left in their folders, declared: read back by reports and comparisons.

Variables are declared on their dimensions, columns of tables by words (:data:`COLUMNS`), and what
a JSON file holds by name; what is null there is not known.
"""

from __future__ import annotations

from dataclasses import replace

from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.judge.chi2 import KINDS, LEVELS
from lusee_bayes.judge.levels import NAMES

NUMBER, COUNT, TEXT = Attribute(), Attribute("integer", low=0.0), Attribute("text")
SIZE, SHARE, FLAG = Attribute(low=0.0), Attribute(low=0.0, high=1.0), Attribute("boolean")
OPTIONAL, OPTIONAL_TEXT = Attribute(optional=True), Attribute("text", optional=True)
OPTIONAL_ELL = Attribute("integer", optional=True)
LEVEL = Attribute("text", choices=LEVELS)
HINT = "give the folder of a finished run"
# of flight data: the spectra behind a map
REDUCED = "reduced.nc"
# the two parts of chi^2 of a map's data
JUDGED = {
    f"{part}_{name}": attribute
    for part in ("instrument", "prior")
    for name, attribute in (("p", SHARE), ("chi2", NUMBER), ("chi2_expected", NUMBER))
}
# what a column of a table holds; "any" may be NaN, "missing" infinite, too
COLUMNS = {
    "text": Variable((), "text"),
    "number": Variable(()),
    "size": Variable((), low=0.0),
    "any": Variable((), finite=False),
    "missing": Variable((), missing=True),
}


def _on(*dims: str, **limits) -> Variable:
    """A variable on these dimensions."""
    return Variable(dims, **limits)


def _table(what: str, dim: str, **columns: str) -> Layout:
    """A table whose columns are of a kind of :data:`COLUMNS` each."""
    found = {name: replace(COLUMNS[kind], dims=(dim,)) for name, kind in columns.items()}
    return Layout(what, found)


def _figures(what: str, **attributes: Attribute) -> Layout:
    """An object of a JSON file."""
    return Layout(what, attributes=attributes)


_SKY = {
    "mean": _on("mode"),
    "std": _on("mode", low=0.0),
    "prior_std": _on("mode", low=0.0),
    "truth": _on("mode", optional=True),
    "draws": _on("draw", "mode", optional=True),
}
_OF_SKY = {"frequency_mhz": SIZE, "lmax": COUNT, "frame": TEXT, "versions": TEXT}
UPDATABLE = Layout(
    "a posterior of lusee-bayes map --updatable",
    {
        **_SKY,
        "precision_root": _on("mode", "mode_2", optional=True),
        "white_mean": _on("mode", optional=True),
        "prior_mean": _on("mode", optional=True),
        "prior_root": _on("mode", "mode_2", optional=True),
    },
    {**_OF_SKY, "log_evidence": OPTIONAL, "data_digests": OPTIONAL_TEXT},
)
POSTERIOR = Layout("a posterior of lusee-bayes map", _SKY, _OF_SKY)
CUBE = Layout(
    "posteriors of lusee-bayes map --frequencies",
    {
        "frequency": _on("frequency", low=0.0, grows=True),
        "mean": _on("frequency", "mode"),
        "std": _on("frequency", "mode", low=0.0),
    },
    # unmapped is said by a run whose channels could not all be mapped
    {"lmax": COUNT, "frame": TEXT, "versions": TEXT, "unmapped": OPTIONAL_TEXT},
)
DIAGNOSTICS = Layout(
    "diagnostics of lusee-bayes map",
    {
        **{name: _on("pixel") for name in ("prior_fraction", "highest_altitude")},
        "draws": _on("draw", "pixel"),
        "region_mean": _on("region"),
        "region_std": _on("region", low=0.0),
        "region_prior_fraction": _on("region"),
        "resolution": _on("mode", "mode_2", kind="integer", low=-127.0, high=127.0),
        "resolution_step": _on("ell", "ell_2", low=0.0),
        "prior_std": _on("mode", low=0.0),
        "product": _on("product", kind="text"),
        "hours": _on("time"),
        **{name: _on("product", "time", finite=False) for name in ("data", "predicted", "z")},
        # none where groups were not judged
        "group_kind": _on("group", kind="text", choices=tuple(KINDS), optional=True),
        "group_name": _on("group", kind="text", optional=True),
        "group_n": _on("group", kind="integer", low=0.0, optional=True),
        "group_degrees": _on("group", low=0.0, optional=True),
        "group_chi2": _on("group", optional=True),
        "group_p": _on("group", low=0.0, high=1.0, optional=True),
        "group_others_p": _on("group", low=0.0, high=1.0, finite=False, optional=True),
    },
    {"frequency_mhz": SIZE, "level": LEVEL, "verdict": TEXT, **JUDGED},
)
MAP_SUMMARY = _figures(
    "the figures of a map run",
    frequency_mhz=SIZE,
    ell_cross=OPTIONAL_ELL,
    **dict.fromkeys(("effective_resolution_deg", "beam_rms_difference"), OPTIONAL),
    never_observed_fraction=SHARE,
    **dict.fromkeys(("log_evidence", "information_bits", "chi2", "chi2_expected"), NUMBER),
    **dict.fromkeys(("peak_memory_gb", "mean_refinement_sigma"), NUMBER),
    **dict.fromkeys(("n_data", "n_missing", "n_modes", "rounds"), COUNT),
    # runs before priors were learned do not say it
    prior=OPTIONAL_TEXT,
)
CUBE_SUMMARY = _figures(
    "the figures of a run of several frequencies",
    level=LEVEL,
    verdict=TEXT,
    **dict.fromkeys(("log_evidence", "peak_memory_gb"), NUMBER),
    **dict.fromkeys(("n_data", "n_modes"), COUNT),
)
CHANNEL_SUMMARY = _figures(
    "the figures of a channel",
    frequency_mhz=SIZE,
    **dict.fromkeys(("n_data", "n_missing"), COUNT),
    instrument_p=SHARE,
    **dict.fromkeys(("chi2", "chi2_expected"), NUMBER),
    ell_cross=OPTIONAL_ELL,
)
# runs of older versions do not say the prior
JOINT_SUMMARY = _figures(
    "the figures of a joint posterior",
    solver=TEXT,
    iterations=COUNT,
    refinement_sigma=NUMBER,
    prior=OPTIONAL_TEXT,
)
DIAGNOSIS = _figures(
    "a usual mistake",
    **dict.fromkeys(("mistake", "remedy"), TEXT),
    **dict.fromkeys(("chi2", "chi2_expected"), NUMBER),
    p=SHARE,
    fits=FLAG,
)
COVERAGE = _figures(
    "the coverage of a part of the sky",
    name=TEXT,
    n=COUNT,
    **{f"{kind}_{name}": NUMBER for kind in ("held", "scatter") for name in NAMES},
    **dict.fromkeys(("rms", "rms_scatter", "largest", "allowed"), NUMBER),
)
SKY_ERRORS = _figures(
    "the errors of a band of latitude", name=TEXT, rms_error_k=NUMBER, std_over_sky=NUMBER
)
PRIORS = _figures(
    "a comparison of priors", verdict=TEXT, frequency_mhz=NUMBER, peak_memory_gb=NUMBER
)
PRIOR = _figures(
    "the data under a prior",
    **dict.fromkeys(("name", "prior"), TEXT),
    parameters=COUNT,
    log_evidence=NUMBER,
    **{f"{x}_{y}": NUMBER for x in ("chi2", "degrees") for y in ("instrument", "prior")},
)
HELD_OUT = _figures(
    "groups of data that were left out",
    kind=Attribute("text", choices=tuple(KINDS)),
    **dict.fromkeys(("groups", "n"), COUNT),
    **dict.fromkeys(("chi2", "log_density"), NUMBER),
)
SNR = _figures("the SNR at a multipole", ell=COUNT, snr=NUMBER)
JOINT_TEST = _figures(
    "a joint test of all channels", test=TEXT, found=TEXT, p=SHARE, among=COUNT, level=LEVEL
)
PULLS = _figures("pulls in a direction", direction=TEXT, rms=NUMBER, worst=NUMBER, worst_mhz=NUMBER)
PROVENANCE = _figures(
    "the provenance of a run's results",
    **dict.fromkeys(("file", "first", "last", "command", "version", "made"), TEXT),
    known_sky=FLAG,
    **dict.fromkeys(("seed", "n_times", "lmax"), Attribute("integer")),
    **dict.fromkeys(("step_s", "lon_deg", "lat_deg"), NUMBER),
)
VALIDATION = _figures("the checks of a validation", passed=FLAG)
CHECK = _figures(
    "a check",
    **dict.fromkeys(("name", "meaning"), TEXT),
    value=NUMBER,
    **dict.fromkeys(("lower", "upper"), OPTIONAL),
    passed=FLAG,
)
SUMMARY_TABLE = _table(
    "a summary of draws", "quantity", quantity="text", mean="any", sd="any", r_hat="missing"
)
SAMPLING = _figures(
    "the figures of a sampled run",
    program=TEXT,
    **dict.fromkeys(("chains", "draws", "divergences"), COUNT),
    mean_acceptance=SHARE,
    peak_memory_gb=NUMBER,
)
SOURCES = _table(
    "fluxes of point sources",
    "source",
    **dict.fromkeys(("source", "block"), "text"),
    flux_jy="number",
    std_jy="size",
)
POINTING = _table(
    "offsets of clock and pointing",
    "offset",
    offset="text",
    value="number",
    **dict.fromkeys(("std", "prior_std", "beyond_first_order"), "size"),
)
# columns in their order in a report
_UNKNOWN = {
    "unknown": "text",
    "unit": "text",
    "value": "number",
    "std": "size",
    "prior": "number",
    "prior_std": "size",
}
UNKNOWNS = _table("receivers, ground and gain table", "unknown", **_UNKNOWN)
CHANNEL_UNKNOWNS = _table(
    "receivers, ground and gain table of several frequencies",
    "unknown",
    frequency_mhz="size",
    **_UNKNOWN,
)
NULL_DIRECTION = _figures(
    "what a map's data cannot tell of receivers, ground and gain table",
    null_share=SIZE,
    null_sentence=TEXT,
)
SPECTRA = _table(
    "spectra of a map",
    "ell",
    ell="size",
    **dict.fromkeys(("cl_prior", "cl_mean", "cl_posterior_variance", "prior_fraction"), "any"),
)
