"""What finished runs have left in their folders, declared: read back by reports and comparisons."""

from __future__ import annotations

from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.judge.chi2 import LEVELS
from lusee_bayes.judge.coverage import NAMES

MODES = Variable(("mode",))
WIDTHS = Variable(("mode",), low=0.0)
NUMBER, COUNT, TEXT = Attribute(), Attribute("integer", low=0.0), Attribute("text")
KINDS = ("product", "day", "angle")
LEVEL = Attribute("text", choices=LEVELS)
HINT = "give the folder of a finished run"
# of flight data: the spectra behind a map
REDUCED = "reduced.nc"
# the two parts of chi^2 of a map's data
JUDGED = {
    f"{part}_{name}": attribute
    for part in ("instrument", "prior")
    for name, attribute in (
        ("p", Attribute(low=0.0, high=1.0)),
        ("chi2", NUMBER),
        ("chi2_expected", NUMBER),
    )
}

POSTERIOR = Layout(
    "a posterior of lusee-bayes map",
    {
        "mean": MODES,
        "std": WIDTHS,
        "prior_std": WIDTHS,
        "truth": Variable(("mode",), optional=True),
        "draws": Variable(("draw", "mode"), optional=True),
    },
    {"frequency_mhz": Attribute(low=0.0), "lmax": COUNT, "frame": TEXT, "versions": TEXT},
)
UPDATABLE = Layout(
    "a posterior of lusee-bayes map --updatable",
    {
        **POSTERIOR.variables,
        "precision_root": Variable(("mode", "mode_2"), optional=True),
        "white_mean": Variable(("mode",), optional=True),
        "prior_mean": Variable(("mode",), optional=True),
        "prior_root": Variable(("mode", "mode_2"), optional=True),
    },
    {
        **POSTERIOR.attributes,
        "log_evidence": Attribute(optional=True),
        "data_digests": Attribute("text", optional=True),
    },
)
CUBE = Layout(
    "posteriors of lusee-bayes map --frequencies",
    {
        "frequency": Variable(("frequency",), low=0.0, grows=True),
        "mean": Variable(("frequency", "mode")),
        "std": Variable(("frequency", "mode"), low=0.0),
    },
    {
        "lmax": COUNT,
        "frame": TEXT,
        "versions": TEXT,
        # of a run whose channels could not all be mapped
        "unmapped": Attribute("text", optional=True),
    },
)
DIAGNOSTICS = Layout(
    "diagnostics of lusee-bayes map",
    {
        "prior_fraction": Variable(("pixel",)),
        "highest_altitude": Variable(("pixel",)),
        "draws": Variable(("draw", "pixel")),
        "region_mean": Variable(("region",)),
        "region_std": Variable(("region",), low=0.0),
        "region_prior_fraction": Variable(("region",)),
        "resolution": Variable(("mode", "mode_2"), "integer", low=-127.0, high=127.0),
        "resolution_step": Variable(("ell", "ell_2"), low=0.0),
        "prior_std": WIDTHS,
        "product": Variable(("product",), "text"),
        "hours": Variable(("time",)),
        "data": Variable(("product", "time"), finite=False),
        "predicted": Variable(("product", "time"), finite=False),
        "z": Variable(("product", "time"), finite=False),
        # none where groups were not judged
        "group_kind": Variable(("group",), "text", choices=KINDS, optional=True),
        "group_name": Variable(("group",), "text", optional=True),
        "group_n": Variable(("group",), "integer", low=0.0, optional=True),
        "group_degrees": Variable(("group",), low=0.0, optional=True),
        "group_chi2": Variable(("group",), optional=True),
        "group_p": Variable(("group",), low=0.0, high=1.0, optional=True),
        "group_others_p": Variable(("group",), low=0.0, high=1.0, finite=False, optional=True),
    },
    {
        "frequency_mhz": Attribute(low=0.0),
        "level": LEVEL,
        "verdict": TEXT,
        **JUDGED,
    },
)
# summary.json, sampling.json; what is null is not known
MAP_SUMMARY = Layout(
    "the figures of a map run",
    attributes={
        "frequency_mhz": Attribute(low=0.0),
        "ell_cross": Attribute("integer", optional=True),
        "effective_resolution_deg": Attribute(optional=True),
        "beam_rms_difference": Attribute(optional=True),
        "never_observed_fraction": Attribute(low=0.0, high=1.0),
        "peak_memory_gb": NUMBER,
        **dict.fromkeys(("log_evidence", "information_bits", "chi2", "chi2_expected"), NUMBER),
        **dict.fromkeys(("n_data", "n_missing", "n_modes", "rounds"), COUNT),
        "mean_refinement_sigma": NUMBER,
        # runs before priors were learned do not say it
        "prior": Attribute("text", optional=True),
    },
)
CUBE_SUMMARY = Layout(
    "the figures of a run of several frequencies",
    attributes={
        "level": LEVEL,
        "verdict": TEXT,
        "log_evidence": NUMBER,
        "n_data": COUNT,
        "n_modes": COUNT,
        "peak_memory_gb": NUMBER,
    },
)
CHANNEL_SUMMARY = Layout(
    "the figures of a channel",
    attributes={
        "frequency_mhz": Attribute(low=0.0),
        "n_data": COUNT,
        "n_missing": COUNT,
        "instrument_p": Attribute(low=0.0, high=1.0),
        **dict.fromkeys(("chi2", "chi2_expected"), NUMBER),
        "ell_cross": Attribute("integer", optional=True),
    },
)
JOINT_SUMMARY = Layout(
    "the figures of a joint posterior",
    attributes={
        "solver": TEXT,
        "iterations": COUNT,
        "refinement_sigma": NUMBER,
        # runs of older versions do not say it
        "prior": Attribute("text", optional=True),
    },
)
DIAGNOSIS = Layout(
    "a usual mistake",
    attributes={
        **dict.fromkeys(("mistake", "remedy"), TEXT),
        **dict.fromkeys(("chi2", "chi2_expected"), NUMBER),
        "p": Attribute(low=0.0, high=1.0),
        "fits": Attribute("boolean"),
    },
)
COVERAGE = Layout(
    "the coverage of a part of the sky",
    attributes={
        "name": TEXT,
        "n": COUNT,
        **{f"{kind}_{name}": NUMBER for kind in ("held", "scatter") for name in NAMES},
        **dict.fromkeys(("rms", "rms_scatter", "largest", "allowed"), NUMBER),
    },
)
SKY_ERRORS = Layout(
    "the errors of a band of latitude",
    attributes={"name": TEXT, **dict.fromkeys(("rms_error_k", "std_over_sky"), NUMBER)},
)
PRIORS = Layout(
    "a comparison of priors",
    attributes={"verdict": TEXT, **dict.fromkeys(("frequency_mhz", "peak_memory_gb"), NUMBER)},
)
PRIOR = Layout(
    "the data under a prior",
    attributes={
        **dict.fromkeys(("name", "prior"), TEXT),
        "parameters": COUNT,
        "log_evidence": NUMBER,
        **{f"{x}_{y}": NUMBER for x in ("chi2", "degrees") for y in ("instrument", "prior")},
    },
)
HELD_OUT = Layout(
    "groups of data that were left out",
    attributes={
        "kind": Attribute("text", choices=KINDS),
        **dict.fromkeys(("groups", "n"), COUNT),
        **dict.fromkeys(("chi2", "log_density"), NUMBER),
    },
)
SNR = Layout("the SNR at a multipole", attributes={"ell": COUNT, "snr": NUMBER})
JOINT_TEST = Layout(
    "a joint test of all channels",
    attributes={
        "test": TEXT,
        "found": TEXT,
        "p": Attribute(low=0.0, high=1.0),
        "among": COUNT,
        "level": LEVEL,
    },
)
PULLS = Layout(
    "pulls in a direction",
    attributes={"direction": TEXT, "rms": NUMBER, "worst": NUMBER, "worst_mhz": NUMBER},
)
PROVENANCE = Layout(
    "the provenance of a run's results",
    attributes={
        **dict.fromkeys(("file", "first", "last", "command", "version", "made"), TEXT),
        "known_sky": Attribute("boolean"),
        **dict.fromkeys(("seed", "n_times", "lmax"), Attribute("integer")),
        **dict.fromkeys(("step_s", "lon_deg", "lat_deg"), NUMBER),
    },
)
VALIDATION = Layout("the checks of a validation", attributes={"passed": Attribute("boolean")})
CHECK = Layout(
    "a check",
    attributes={
        "name": TEXT,
        "value": NUMBER,
        "lower": Attribute(optional=True),
        "upper": Attribute(optional=True),
        "passed": Attribute("boolean"),
        "meaning": TEXT,
    },
)
SUMMARY_TABLE = Layout(
    "a summary of draws",
    {
        "quantity": Variable(("quantity",), "text"),
        "mean": Variable(("quantity",), finite=False),
        "sd": Variable(("quantity",), finite=False),
        "r_hat": Variable(("quantity",), missing=True),
    },
)
SAMPLING = Layout(
    "the figures of a sampled run",
    attributes={
        "program": TEXT,
        "chains": COUNT,
        "draws": COUNT,
        "divergences": COUNT,
        "mean_acceptance": Attribute(low=0.0, high=1.0),
        "peak_memory_gb": NUMBER,
    },
)
SOURCES = Layout(
    "fluxes of point sources",
    {
        "source": Variable(("source",), "text"),
        "block": Variable(("source",), "text"),
        "flux_jy": Variable(("source",)),
        "std_jy": Variable(("source",), low=0.0),
    },
)
POINTING = Layout(
    "offsets of clock and pointing",
    {
        "offset": Variable(("offset",), "text"),
        "value": Variable(("offset",)),
        "std": Variable(("offset",), low=0.0),
        "prior_std": Variable(("offset",), low=0.0),
        "beyond_first_order": Variable(("offset",), low=0.0),
    },
)
UNKNOWNS = Layout(
    "receivers, ground and gain table",
    {
        "unknown": Variable(("unknown",), "text"),
        "unit": Variable(("unknown",), "text"),
        "value": Variable(("unknown",)),
        "std": Variable(("unknown",), low=0.0),
        "prior": Variable(("unknown",)),
        "prior_std": Variable(("unknown",), low=0.0),
    },
)
CHANNEL_UNKNOWNS = Layout(
    "receivers, ground and gain table of several frequencies",
    {"frequency_mhz": Variable(("unknown",), low=0.0), **UNKNOWNS.variables},
)
NULL_DIRECTION = Layout(
    "what a map's data cannot tell of receivers, ground and gain table",
    attributes={"null_share": Attribute(low=0.0), "null_sentence": TEXT},
)
SPECTRA = Layout(
    "spectra of a map",
    {
        "ell": Variable(("ell",), low=0.0),
        **{
            name: Variable(("ell",), finite=False)
            for name in ("cl_prior", "cl_mean", "cl_posterior_variance", "prior_fraction")
        },
    },
)
