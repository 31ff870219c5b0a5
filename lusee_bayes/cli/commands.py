"""The commands: what each does in one line, and examples of it.

They are not in the docstrings of the commands: ``lusee-bayes --help`` imports none of them.
"""

from __future__ import annotations

# the module of each
MODULES = {
    "map_commands": ("map", "simulate", "reduce", "average"),
    "sample_commands": ("sample", "validate"),
    "plan_command": ("plan",),
    "look_commands": ("compare", "compare-priors", "report", "info", "keys", "paper"),
}
# the summary with what else there is to know, and examples
COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "simulate": (
        "Simulate the visibilities of a scenario.",
        (
            "lusee-bayes simulate fiducial --set seed=2 -o data.nc",
            "lusee-bayes simulate fiducial --frequencies 10:30:5 -o waterfall.fits",
        ),
    ),
    "average": (
        "Average data over longer times, and say what that costs.\n\n"
        "Data then need less memory and time to map. The cost is information about the map, in "
        "bits, by the forecast that plan makes.",
        (
            "lusee-bayes average data.nc --to 2h -o averaged.nc",
            "lusee-bayes average data.nc --to 30min --scenario gain_1e-2 --set lmax=31",
        ),
    ),
    "reduce": (
        "Calibrate, flag and average sessions of the spectrometer.\n\n"
        "What the files leave open (gain table, bin origin, what the times are, a clock) is said "
        "by the scenario. map does the same with --data SESSION..., for its own frequencies.",
        (
            "lusee-bayes reduce first_light.yaml session_*.h5 --frequencies 5:50:1 -o reduced.nc",
            "lusee-bayes reduce first_light.yaml session.h5 --clock clock.json -o reduced.nc",
        ),
    ),
    "map": (
        "Make a posterior map of a scenario, or of given data.",
        (
            "lusee-bayes map fiducial --set frequency_mhz=10 -o output/ten",
            "lusee-bayes map fiducial --data data.nc -o output/measured",
            "lusee-bayes map fiducial --data waterfall.fits --set beam.file=beam.fits",
            "lusee-bayes map first_light.yaml --data session_*.h5 --clock clock.json",
            "lusee-bayes map first_light.yaml --data reduced.nc --frequencies 5:50:1",
            "lusee-bayes map fiducial --frequencies 5:50:1 --joint --draws 20 -o output/cube",
            "lusee-bayes map fiducial --data second_cycle.nc --add output/first_cycle",
        ),
    ),
    "sample": (
        "Sample the posterior of a NumPyro program by Hamiltonian Monte Carlo.\n\n"
        "Draws are written during the run: after an interruption, --resume continues it.",
        (
            "lusee-bayes sample fiducial --set lmax=20 --draws 500 -o output/hmc",
            "lusee-bayes sample fiducial --model my_model.py --set lmax=12",
            "lusee-bayes sample gain_1e-2 --frequencies 10,25,40 --resume -o output/three",
        ),
    ),
    "plan": (
        "Forecast the information in observations, without data.",
        (
            "lusee-bayes plan fiducial gain_1e-2 -o output/plan",
            "lusee-bayes plan fiducial --vary frequency_mhz=10,25,40",
        ),
    ),
    "validate": (
        "Check the posterior by HMC and by simulated data sets.\n\n"
        "Ends with exit code 1 if a check fails; validation.md holds the thresholds.",
        ("lusee-bayes validate gain_1e-2 --set lmax=8 -o output/check",),
    ),
    "paper": (
        "Reproduce the figures of the reference paper and judge its claims.\n\n"
        "Cases that were computed before with the same scenario and version are kept, so that an "
        "interrupted run continues where it stopped.",
        (
            "lusee-bayes paper",
            "lusee-bayes paper -o output/ulsa --sky exp1.0MHz_sky.hdf5 exp10.0MHz_sky.hdf5",
        ),
    ),
    "report": (
        "Write report.html of a finished run again.",
        ("lusee-bayes report output/fiducial",),
    ),
    "compare": (
        "Set finished map runs side by side.",
        ("lusee-bayes compare output/fiducial output/gain_1e-2",),
    ),
    "compare-priors": (
        "Map one data set under several priors, and say which of them it prefers.",
        (
            "lusee-bayes compare-priors fiducial --set lmax=31 -o output/priors",
            "lusee-bayes compare-priors fiducial --data data.nc --priors isotropic,local_scales",
        ),
    ),
    "info": (
        "Describe the contents of files, or of runs' folders.",
        (
            "lusee-bayes info output/fiducial",
            "lusee-bayes info output/fiducial/posterior.nc",
            "lusee-bayes info beam.fits",
            "lusee-bayes info session_*.h5",
        ),
    ),
    "keys": (
        "List the keys of a scenario: meaning, unit, choices, default.",
        ("lusee-bayes keys", "lusee-bayes keys noise.gain"),
    ),
}


def help_of(name: str) -> str:
    """Return the text of ``lusee-bayes NAME --help`` above its parameters.

    What Markdown (the terminal) and reST (the site) both read.
    """
    text, examples = COMMANDS[name]
    return "\n".join([text, "", "**Examples**", "", *(f"- ``{one}``" for one in examples)])
