"""The commands: each parses its options, calls a run and prints what it has found.

What a command runs is imported when it is called, so that ``--help`` and completion answer at once.
The docstrings are the help: what Markdown (the terminal) and reST (the site) both read.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Algorithm,
    ChainOptions,
    Count,
    DataOptions,
    Duration,
    EngineOptions,
    Flag,
    Frequencies,
    Many,
    Number,
    Options,
    Quiet,
    Repeated,
    ScenarioOptions,
    say,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.version import release

app = App(
    name="lusee-bayes",
    version=release,
    suppress_keyboard_interrupt=False,
    # [ begins a file's name like any other character
    default_parameter=Parameter(json_list=False, json_dict=False),
    help=(
        "Bayesian maps of the low-frequency sky from LuSEE-Night's visibilities.\n\n"
        "Exit codes: 0 success, 1 a validation failed, or workers, memory or disk gave out, 2 bad "
        "input (one sentence on standard error), 130 interrupted, 143 terminated. lusee-bayes "
        "COMMAND --help shows examples."
    ),
)
app.register_install_completion_command()


# mapped where no scenario is named
FIRST_MAP = "first_map"


@app.command(name="map")
def map_command(
    scenario: str | None = None,
    *,
    truth: Flag = False,
    draws: Number | None = None,
    covariance: Flag = False,
    information: Flag = False,
    add: Path | None = None,
    diagnose: Flag = False,
    frequencies: Frequencies | None = None,
    joint: Flag = False,
    options: DataOptions = DataOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Make a posterior map of a scenario, or of given data.

    The results are in output/NAME, unless --output names another folder.

    **Examples**

    - ``lusee-bayes map``
    - ``lusee-bayes map fiducial --set frequency_mhz=10 -o output/ten``
    - ``lusee-bayes map fiducial --data data.nc -o output/measured``
    - ``lusee-bayes map fiducial --data waterfall.fits --set beam.file=beam.fits``
    - ``lusee-bayes map first_light.yaml --data session_*.h5 --clock clock.json``
    - ``lusee-bayes map first_light.yaml --data reduced.nc --frequencies 5:50:1``
    - ``lusee-bayes map fiducial --frequencies 5:50:1 --joint --draws 20 -o output/cube``
    - ``lusee-bayes map fiducial --data second_cycle.nc --add output/first_cycle``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (default: first_map).
    truth
        Compare the map with the scenario's sky: for data that were simulated from it.
    draws
        Number of posterior draws to keep in posterior.nc (output.draws).
    covariance
        Keep the posterior covariance in posterior.nc (output.covariance).
    information
        Keep the information of the data about the sky in posterior.nc, for --add
        (output.information).
    add
        Folder of a run with --information: combine its data with these.
    diagnose
        Judge every group of data, and try the usual mistakes (signs, exchanged ports, angles,
        clocks, ...), even if the data fit; where they do not, both is done anyway.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step: a map of each, on its own. The same
        command continues an interrupted run.
    joint
        One posterior for the skies of all channels, with the scenario's spectral prior.
    """
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.map_run import run_map

    if scenario is None and options.data is not None:
        raise InputError("--data needs the scenario of its instrument: lusee-bayes map SCENARIO")
    scenario = scenario or FIRST_MAP
    kept = {"output__draws": draws, "output__covariance": covariance}
    kept["output__information"] = information
    loaded = options.load(scenario, frequencies_mhz=frequencies, joint=joint, **kept)
    several = bool(loaded.frequencies_mhz)
    if not several and engine != EngineOptions():
        raise InputError("--workers and --cluster share out channels; give --frequencies")
    with engine.open(demand_of(loaded)) if several else nullcontext() as opened:
        given = {"truth": truth, "earlier": add, "thorough": diagnose}
        run = run_map(loaded, options.folder(scenario), engine=opened, **given, **options.running())
    lines = run.result.lines(verbose=options.verbose)
    options.tell(*lines, f"look at {run.page}", files=run.files)


@app.command(name="simulate")
def simulate_command(
    scenario: str,
    *,
    frequencies: Frequencies | None = None,
    flight: Flag = False,
    options: ScenarioOptions = ScenarioOptions(),
) -> None:
    """Simulate the visibilities of a scenario.

    They are in data.nc, unless --output names another file: netCDF, or luseepy's waterfall if the
    name ends in .fits. Sessions are in the folder flight, or in that of --output.

    **Examples**

    - ``lusee-bayes simulate fiducial --set seed=2 -o data.nc``
    - ``lusee-bayes simulate fiducial --frequencies 10:30:5 -o waterfall.fits``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    frequencies
        Channels of a waterfall in MHz, as 10,25,30 or as first:last:step; the noise of each has a
        seed of its own, one more than that of the channel before.
    flight
        Write sessions of the spectrometer, as they come from the lander (flight.simulated).
    """
    from lusee_bayes.runs.data_run import run_simulate, run_simulate_flight

    loaded = options.load(scenario, frequencies_mhz=frequencies)
    if flight:
        files = run_simulate_flight(loaded, options.output or Path("flight"), **options.running())
        options.tell(*files.lines())
        return
    path = options.output or Path("data.nc")
    data = run_simulate(loaded, path, **options.running())
    options.tell(
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {path}",
    )


@app.command(name="reduce")
def reduce_command(
    scenario: str,
    files: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    frequencies: Frequencies | None = None,
    clock: str | None = None,
    options: ScenarioOptions = ScenarioOptions(),
) -> None:
    """Calibrate, flag and average sessions of the spectrometer.

    What the files leave open (gain table, bin origin, what the times are, a clock) is said by the
    scenario. map does the same with --data SESSION..., for its own frequencies. The bands are in
    reduced.nc, unless --output names another file, for map --data.

    **Examples**

    - ``lusee-bayes reduce first_light.yaml session_*.h5 --frequencies 5:50:1 -o reduced.nc``
    - ``lusee-bayes reduce first_light.yaml session.h5 --clock clock.json -o reduced.nc``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package, with a section flight.
    files
        Sessions that luseepy has written, HDF5 or FITS, in any order.
    frequencies
        Middles of the bands in MHz, as 10,25,30 or as first:last:step.
    clock
        Clock reference in JSON, for sessions with no absolute time, or to correct the UTC that they
        state (flight.clock).
    """
    from lusee_bayes.core.checks import counted
    from lusee_bayes.runs.data_run import reduced_lines, run_reduce

    loaded = options.load(scenario, frequencies_mhz=frequencies, flight__clock=clock)
    path = options.output or Path("reduced.nc")
    reduced = run_reduce(loaded, files, path, **options.running())
    bands = counted(len(reduced.frequencies_mhz), "band")
    options.tell(*reduced_lines(reduced), f"{bands} -> {path}")


@app.command(name="average")
def average_command(
    data: Path,
    *,
    to: Duration,
    scenario: str = "fiducial",
    no_information: Flag = False,
    options: ScenarioOptions = ScenarioOptions(),
) -> None:
    """Average data over longer times, and say what that costs.

    Data then need less memory and time to map. The cost is information about the map, in bits, by
    the forecast that plan makes. The averages are in averaged.nc, unless --output names another
    file.

    **Examples**

    - ``lusee-bayes average data.nc --to 2h -o averaged.nc``
    - ``lusee-bayes average data.nc --to 30min --scenario gain_1e-2 --set lmax=31``

    Parameters
    ----------
    data
        Visibilities whose samples have windows; of a waterfall the scenario's frequency is taken.
    to
        Length of the averages: 30s, 10min, 2h, 1d.
    scenario
        Instrument, noise and prior for the information that is lost: a YAML file, or the name of a
        scenario of the package.
    no_information
        Leave out the information, which takes the memory and the time of two maps.
    """
    from lusee_bayes.runs.data_run import run_average

    path = options.output or Path("averaged.nc")
    loaded, information = options.load(scenario), not no_information
    run = run_average(loaded, data, to, path, information=information, **options.running())
    options.tell(*run.lines(), f"{run.averaged.layout.size} visibilities -> {path}")


@app.command(name="sample")
def sample_command(
    scenario: str,
    *,
    model: str | None = None,
    algorithm: Algorithm | None = None,
    frequencies: Frequencies | None = None,
    options: DataOptions = DataOptions(),
    chains: ChainOptions = ChainOptions(),
) -> None:
    """Sample the posterior of a NumPyro program by Hamiltonian Monte Carlo.

    Draws are written during the run: after an interruption, --resume continues it. The results are
    in output/NAME-PROGRAM, unless --output names another folder.

    **Examples**

    - ``lusee-bayes sample fiducial --set lmax=20 --draws 500 -o output/hmc``
    - ``lusee-bayes sample fiducial --model my_model.py --set lmax=12``
    - ``lusee-bayes sample gain_1e-2 --frequencies 10,25,40 --resume -o output/three``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    model
        The program: a Python file with a function model, or one of the package by its name (sky,
        sky_marginal, gains, instrument, ...). By default systematics, where the scenario says that
        something is to be sampled, else sky.
    algorithm
        nuts, the No-U-Turn Sampler; hmc, Hamiltonian Monte Carlo with trajectories of fixed length;
        or crank-nicolson, without gradients, the default where rounds have found what is sampled.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step, one after the other: each in a folder of
        its own, and their maps together in cubes. With --resume, finished ones are taken over.
    """
    from lusee_bayes.runs.sample_run import default_program, run_sample
    from lusee_bayes.sampling.programs import load_program

    loaded = options.load(scenario, frequencies_mhz=frequencies)
    program = default_program(loaded) if model is None else load_program(model)
    given = chains.running(loaded.seed, algorithm) | options.running()
    run = run_sample(loaded, options.folder(scenario, f"-{program.name}"), program=program, **given)
    several, lines = bool(loaded.frequencies_mhz), []
    for result in run.result:
        lines += [f"{result.experiment.scenario.frequency_mhz:g} MHz"] * several + result.lines()
    there = f"the {run.page.name} of every channel in {run.folder}" if several else run.page
    options.tell(*lines, f"look at {there}", files=run.files)


@app.command(name="validate")
def validate_command(
    scenario: str,
    *,
    simulations: Count = 500,
    options: DataOptions = DataOptions(),
    chains: ChainOptions = ChainOptions(),
    engine: EngineOptions = EngineOptions(),
) -> int:
    """Check the posterior of a scenario by HMC and by simulated data sets.

    Ends with exit code 1 if a check fails; the thresholds are in validation.md. The results are in
    output/NAME-validation, unless --output names another folder.

    **Examples**

    - ``lusee-bayes validate gain_1e-2 --set lmax=8 -o output/check``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    simulations
        Data sets for simulation-based calibration.
    """
    from lusee_bayes.sampling.least import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(chains.draws)
    loaded = options.load(scenario)
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.runs.sample_run import demand_of_calibration, run_validate

    with engine.open(demand_of_calibration(loaded)) as opened:
        given = {"name": Path(scenario).stem, "simulations": simulations, "engine": opened}
        given |= chains.running(loaded.seed) | options.running()
        run = run_validate(loaded, options.folder(scenario, "-validation"), **given)
    verdict = f"{run.result.headline()}; look at {run.page}"
    options.tell(verdict, files=run.files, table=checks_table(run.result.checks))
    return 0 if run.result.passed else 1


@app.command(name="plan")
def plan_command(
    scenario: str,
    *others: str,
    vary: Annotated[tuple[str, ...], Repeated] = (),
    options: ScenarioOptions = ScenarioOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Forecast the information in observations, without data.

    That is information, modes with SNR > 1 and ell_cross. Table and figure are in output/plan,
    unless --output names another folder.

    **Examples**

    - ``lusee-bayes plan fiducial gain_1e-2 -o output/plan``
    - ``lusee-bayes plan fiducial --vary frequency_mhz=10,25,40``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    others
        More scenarios; each is planned with all variations.
    vary
        key.path=value,value,...; an entry of the scenario and the values to try, as often as
        needed, instead of turntable, duration, nights, duty cycle and lost antennas.
    """
    from lusee_bayes.cli.tables import forecast_table
    from lusee_bayes.results.forecast import forecast_lines
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.plan_run import run_plan, variations_of

    sources, given = [scenario, *others], options.running()
    variations = variations_of(sources, options.set_, vary, given["stages"])
    with engine.open(demand_of(*(v.scenario for v in variations))) as opened:
        run = run_plan(variations, options.output or Path("output/plan"), engine=opened, **given)
    by_source = [[f for f in run.result if f.variation.source == source] for source in sources]
    for forecasts in by_source:
        options.tell(table=forecast_table(forecasts))
    lines = [line for forecasts in by_source for line in forecast_lines(forecasts)]
    options.tell(*lines, f"look at {run.folder}/figures/plan.png", files=run.files)


@app.command(name="compare")
def compare_command(*folders: Path, options: Options = Options()) -> None:
    """Set finished map runs side by side: maps, spectra, evidence.

    comparison.html, comparison.csv and the figures are in output/comparison, unless --output names
    another folder.

    **Examples**

    - ``lusee-bayes compare output/fiducial output/gain_1e-2``

    Parameters
    ----------
    folders
        Results of map, two or more.
    """
    from lusee_bayes.cli.tables import comparison_table
    from lusee_bayes.results.finished_runs import evidence_caveat
    from lusee_bayes.runs.compare_run import run_compare

    run = run_compare(folders, options.output or Path("output/comparison"), **options.running())
    lines = filter(None, [evidence_caveat(run.result), f"look at {run.folder}/comparison.html"])
    options.tell(*lines, files=run.files, table=comparison_table(run.result))


@app.command(name="compare-priors")
def compare_priors_command(
    scenario: str,
    *,
    truth: Flag = False,
    priors: str | None = None,
    options: DataOptions = DataOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Map one data set under several priors, and say which of them it prefers.

    The results are in output/NAME-priors, unless --output names another folder.

    **Examples**

    - ``lusee-bayes compare-priors fiducial --set lmax=31 -o output/priors``
    - ``lusee-bayes compare-priors fiducial --data data.nc --priors isotropic,local_scales``

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    truth
        The given data are of the scenario's own sky: count how often error bars hold it.
    priors
        Two or more, with commas: isotropic, isotropic-sky (C_ell of the scenario's sky; simulated
        data only), local_scales. By default all that can be. The scenario's
        own section counts for the prior of its kind.
    """
    from lusee_bayes.cli.tables import table_of_numbers
    from lusee_bayes.runs.compare_run import run_compare_priors
    from lusee_bayes.runs.cost import demand_of

    loaded = options.load(scenario)
    names = None if priors is None else [n.strip() for n in priors.split(",") if n.strip()]
    with engine.open(demand_of(loaded)) as opened:
        folder = options.folder(scenario, "-priors")
        given = {"truth": truth, "name": Path(scenario).stem, "engine": opened}
        run = run_compare_priors(loaded, folder, names, **given, **options.running())
    lines = [*run.result.lines(), f"look at {run.page}"]
    options.tell(*lines, files=run.files, table=table_of_numbers(*run.result.table()))


@app.command(name="report")
def report_command(folder: Path, *, quiet: Quiet = False) -> None:
    """Write report.html again from the results in the folder of a run.

    **Examples**

    - ``lusee-bayes report output/fiducial``

    Parameters
    ----------
    folder
        Results of map, sample or validate.
    quiet
        Print nothing but errors.
    """
    from lusee_bayes.report.pages import write_report

    say(Console(quiet=quiet, soft_wrap=True), f"look at {write_report(folder)}")


@app.command(name="info")
def info_command(files: Annotated[list[Path], Parameter(required=True)], /) -> int:
    """Describe the contents of files, or of runs' folders.

    That is visibilities, sessions, a posterior, samples, a sky, beams.

    **Examples**

    - ``lusee-bayes info output/fiducial``
    - ``lusee-bayes info output/fiducial/posterior.nc``
    - ``lusee-bayes info beam.fits``
    - ``lusee-bayes info session_*.h5``

    Parameters
    ----------
    files
        One or several; one that cannot be read is named, and the others are shown.
    """
    from lusee_bayes.report.describe import describe

    console, errors = Console(soft_wrap=True), Console(stderr=True, soft_wrap=True)
    refused = 0
    for number, file in enumerate(files):
        try:
            told = describe(file)
        except InputError as error:
            say(errors, f"lusee-bayes: {error}")
            refused += 1
        else:
            # a part for each
            say(console, f"\n{told}" if number else told)
    return 2 if refused else 0


@app.command(name="keys")
def keys_command(key: str = "", *, markdown: Flag = False) -> None:
    """List the keys of a scenario: meaning, unit, choices, default.

    **Examples**

    - ``lusee-bayes keys``
    - ``lusee-bayes keys noise.gain``

    Parameters
    ----------
    key
        A key, or a section (noise, noise.gain, ...): list only what is in it.
    markdown
        Write a table of Markdown.
    """
    from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys

    keys = scenario_keys(key)
    lines = [keys_as_markdown(keys).rstrip()] if markdown else map(str, keys)
    say(Console(soft_wrap=True), *lines)


@app.command(name="paper")
def paper_command(
    *,
    sky: Annotated[tuple[Path, ...], Many] = (),
    options: Options = Options(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Reproduce the figures of the reference paper and judge its claims.

    Cases that were computed before with the same scenario and version are kept, so that an
    interrupted run continues where it stopped. Cases, figures and tables are in output/paper,
    unless --output names another folder.

    **Examples**

    - ``lusee-bayes paper``
    - ``lusee-bayes paper -o output/ulsa --sky exp1.0MHz_sky.hdf5 exp10.0MHz_sky.hdf5``

    Parameters
    ----------
    sky
        ULSA HDF5 files with the frequency in their names, as exp10.0MHz_sky.hdf5; each case scales
        the one nearest in log frequency.
        Without them the embedded sky is used.
    """
    from lusee_bayes.paper.cases import paper_scenarios
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.paper_run import run_paper

    folder = options.output or Path("output/paper")
    with engine.open(demand_of(*paper_scenarios(skies=sky).values())) as opened:
        run = run_paper(folder, skies=sky, engine=opened, **options.running())
    verdict = (run.folder / "claims.md").read_text(encoding="utf-8").splitlines()[0]
    files = [path for path in run.files if path.suffix != ".nc"]
    options.tell(verdict, f"look at {run.folder}/claims.md", files=files)
