"""Runs that sample a program given an experiment's data; their draws survive a kill.

A sampling run draws from the posterior of a NumPyro program. A validation compares HMC and
simulated data sets with the analytic posterior.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from dataclasses import replace as replace_fields
from itertools import chain
from pathlib import Path

import numpy as np
import xarray as xr
from numpyro.infer.hmc import HMCState

from lusee_bayes.core import files, version
from lusee_bayes.core.engine import Demand, Engine
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming, reading
from lusee_bayes.experiment.data_files import Data
from lusee_bayes.experiment.experiment import Experiment, infer, program_pieces, sampled_together
from lusee_bayes.experiment.model import true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.linear.amplitudes import Amplitudes, template_amplitudes
from lusee_bayes.report.figures import sampling as figures
from lusee_bayes.report.rendering import render_text
from lusee_bayes.results.finished_runs import Provenance, write_cubes, write_map
from lusee_bayes.results.sample_result import CHAINS, SAMPLES, SampleResult, ValidationResult
from lusee_bayes.runs.cost import demand_of, measured_experiment
from lusee_bayes.runs.folder import Output, RunKind, RunOutcome, contents_of, run_folder
from lusee_bayes.sampling import datatree, least, programs
from lusee_bayes.sampling.distributions import Marginal, TimesStudentT
from lusee_bayes.sampling.hmc import CHUNK, Chains, Checkpoints, Sampler, Whitening, sample
from lusee_bayes.sampling.mode import laplace_approximation
from lusee_bayes.sampling.programs import Program
from lusee_bayes.sampling.shared_sites import SharedSites, gaussian_of_sites, of_channel, site_in
from lusee_bayes.sampling.validation import BATCH, N_DRAWS, calibrate_sky, validate_draws
from lusee_bayes.sky.spectral_prior import SpectralPrior
from lusee_bayes.systematics import gain_drifts, registered
from lusee_bayes.systematics.systematic import SKY, Chart, Systematic, Unknown

# number of starts of the search for the mode of a collapsed program
STARTS = 4


def sample_together(
    experiments: Mapping[str, Experiment],
    program: Program,
    sampler: Sampler,
    folder: Path,
    *,
    skies: SpectralPrior | None = None,
    resume: bool = False,
    stages: Stages | None = None,
) -> tuple[SampleResult, ...]:
    """Sample ``program`` given experiments' data; draws are saved in ``folder``/chains.

    Several channels, which share unknowns, are sampled as one program.

    Parameters
    ----------
    experiments : mapping of Experiment
        One for each channel, by its results folder in ``folder`` (empty for a single channel).
    program : Program
    sampler : Sampler
    folder : Path
        Folder of the run, including unfinished chains.
    skies : SpectralPrior, optional
        Over the skies of all channels, for their joint posterior.
    resume : bool
        Continue an unfinished run with the same settings, or read a finished one.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        If ``folder`` has an unfinished run and ``resume`` is not given, if the unfinished run has
        other settings, if the program does not end with draws of the sky, or if it does not
        integrate out skies with a joint prior.
    """
    stages = stages or Stages()
    with stages("posterior"):
        inferences = {name: infer(one) for name, one in experiments.items()}
    several = len(experiments) > 1
    identity = {
        "scenario": "---\n".join(one.scenario.to_yaml() for one in experiments.values()),
        "input file": "\n".join(contents_of(one.scenario) for one in experiments.values()),
        "data": " ".join(one.data.digest() for one in experiments.values()),
        "program": program.name,
        "program text": program.digest,
        **{f"sampler's {name}": value for name, value in sampler.identity().items()},
        "versions": version.versions(with_commit=False),
        **({} if skies is None else {"skies": "joint"}),
    }
    if resume and not (folder / CHAINS).exists():
        trees = [_finished(folder / name / SAMPLES, identity, sampler) for name in experiments]
        if all(one is not None for one in trees):
            made = zip(experiments.values(), inferences.values(), trees, strict=True)
            return tuple(SampleResult(*one, stages.seconds, None) for one in made)
    arguments, latent = {}, {}
    for name, one in experiments.items():
        inference = inferences[name]
        arguments[name] = program.arguments(inference.model, program_pieces(one))
        n_modes = len(inference.posterior.mean)
        latent[name] = programs.require_sampleable(program, arguments[name], one.data.data, n_modes)
        observing = {**arguments[name], programs.DATA: one.data.data}
        if skies is not None and not programs.predicts(program.model, observing, Marginal):
            raise InputError(
                f"the program '{program.path or program.name}' does not integrate skies out, as a "
                "joint posterior requires: observe 'data' with lb.Marginal(gaussian), and return "
                "gaussian; if nothing else is unknown, lusee-bayes map --joint --draws N is exact"
            )
    data = {name: one.data.data for name, one in experiments.items()}
    first = next(iter(experiments))
    frequencies = {name: one.scenario.frequency_mhz for name, one in experiments.items()}
    octaves = sampled_together(experiments[first])
    if several:
        model = SharedSites(program.model, frequencies, octaves, skies)
        observed = {"channels": arguments, "data": data}
    else:
        model, observed = program.model, {**arguments[first], "data": data[first]}
    whitening = None
    with stages("coordinates"):
        rounds = amplitudes_of_rounds(inferences, latent)
        if rounds is not None and skies is None:
            sites = programs.latent_sites(model, observed)
            whitening = gaussian_of_sites(*rounds, frequencies, octaves, sites)
        elif not several:
            given = arguments[first], experiments[first].data, inferences[first], latent[first]
            whitening = coordinates(program, *given)
        else:
            begin = [(name, start_values(one, latent[name])) for name, one in inferences.items()]
            start = {site_in(name, n): v for name, values in begin for n, v in values.items()}
            fixed = [site_in(name, n) for name in latent for n in gain_drifts.SCALES]
            mode = laplace_approximation(model, observed, start, fixed)
            whitening = mode.whitening if bool(mode.converged) else None
        if rounds is not None and whitening is not None:
            sampler = replace_fields(sampler, algorithm=sampler.algorithm or "crank-nicolson")
    checkpoints = Checkpoints(folder / CHAINS, identity, resume=resume)
    checkpoints.chunks()  # a damaged one is no fault of the program
    times = []
    with stages.progress("sampling", sampler.warmup + sampler.draws) as update:

        def report(iteration: int, state: HMCState) -> None:
            times.append((time.perf_counter(), iteration))
            update(iteration, _state_in_words(iteration, state, sampler))

        with naming(f"the program '{program.path or program.name}'"):
            chains = sample(model, observed, sampler, whitening, checkpoints, report)
    if skies is not None:
        with stages("skies"):
            drawn = model.drawn_skies(**observed, chains=chains, seed=sampler.seed)
            sites = chains.sites | {site_in(name, SKY): drawn[name] for name in drawn}
            chains = replace_fields(chains, sites=sites)
    speed, results = _speed(times, chains, sampler.warmup), []
    for name, one in experiments.items():
        with stages("data tree"):
            inference, scenario = inferences[name], one.scenario
            said = {
                "coordinates": "learned in warmup" if whitening is None else "white",
                "identity": json.dumps(identity),
                "frequency_mhz": scenario.frequency_mhz,
                "frame": "galactic",
                "scenario": scenario.to_yaml(),
            }
            drawn = of_channel(chains, name) if several else chains
            given = drawn, program, inference.model, inference.posterior, one.data
            known = None if one.setup.measured else true_values(one.setup)
            more = {"arguments": arguments[name], "truth": known}
            tree = datatree.to_datatree(*given, seed=sampler.seed, attributes=said, **more)
        results.append(SampleResult(one, inference, tree, stages.seconds, speed))
    return tuple(results)


def coordinates(
    program: Program, arguments: dict, data: Visibilities, inference: Inference, latent: list[str]
) -> Whitening | None:
    """White coordinates for a program: of the analytic posterior if it samples only the sky and the
    data are Gaussian about it, else about its mode. None if no mode is found: warmup then learns
    scales."""
    if latent == [SKY] and not programs.predicts(program.model, arguments, TimesStudentT):
        return Whitening.of(inference.posterior)
    start, arguments = start_values(inference, latent), {**arguments, "data": data.data}
    starts = 1 if SKY in latent else STARTS
    chart = _chart(arguments, latent)
    mode = laplace_approximation(program.model, arguments, start, gain_drifts.SCALES, starts, chart)
    return mode.whitening if bool(mode.converged) else None


def amplitudes_of_rounds(
    inferences: Mapping[str, Inference], latent: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Amplitudes], list[Unknown]] | None:
    """Constraints from each channel's data on unknowns that are linear or inferred in rounds.

    None if others are sampled, too. ``latent`` lists the sampled sites of each channel.
    """
    amplitudes, unknowns = {}, []
    for channel, one in inferences.items():
        sites = set(latent[channel])
        held = [p for p in one.expanded if {u.name for u in p.systematic.unknowns} <= sites]
        unknowns = [u for part in held for u in part.systematic.unknowns]
        known_well = one.moving or not any(part.systematic.scales_sky for part in held)
        if not known_well or {u.name for u in unknowns} != sites:
            return None
        given = template_amplitudes(one.solution, np.concatenate([p.columns for p in held], axis=1))
        expected = np.concatenate([part.expected for part in held])
        amplitudes[channel] = replace_fields(given, mean=expected + given.mean)
    return amplitudes, unknowns


def start_values(inference: Inference, latent: Sequence[str]) -> dict[str, np.ndarray]:
    """Start values of the search for the mode: results of the rounds, if there were any."""
    start = {SKY: inference.posterior.mean} if SKY in latent else {}
    for part in inference.expanded if inference.moving else ():
        values = part.systematic.values(part.expected + inference.amplitudes(part).mean)
        start |= {name: np.asarray(value) for name, value in values.items() if name in latent}
    return start


def _chart(arguments: dict, latent: list[str]) -> Chart | None:
    """The curved coordinates of a systematic among a program's arguments, if any."""
    if (gaussian := arguments.get("gaussian")) is None:
        return None
    pieces = chain.from_iterable(p if isinstance(p, tuple) else (p,) for p in arguments.values())
    charts = (piece.chart(gaussian) for piece in pieces if isinstance(piece, Systematic))
    return next((c for c in charts if c is not None and set(c.names) <= set(latent)), None)


def _finished(path: Path, identity: dict, sampler: Sampler) -> xr.DataTree | None:
    """Read the samples of a finished run; None without a file, InputError if settings differ."""
    if not path.exists():
        return None
    tree = datatree.read_datatree(path)
    with reading(path, "samples"):
        same = json.loads(tree.attrs["identity"]) == json.loads(json.dumps(identity))
    if not same or tree["posterior"].sizes["draw"] != sampler.draws:
        raise InputError(
            f"'{path.parent}' contains a finished run with other settings or number of draws; "
            "give another folder, or --force without --resume to replace its draws"
        )
    return tree


def _state_in_words(iteration: int, state: HMCState, sampler: Sampler) -> str:
    phase = "warmup" if iteration <= sampler.warmup else "draws"
    steps, size = float(state.num_steps.mean()), float(state.adapt_state.step_size.mean())
    accepted = float(state.mean_accept_prob.mean())
    return f"{phase}, steps {steps:.0f} x {size:.3f}, acceptance {accepted:.2f}"


def _speed(times: list[tuple[float, int]], chains: Chains, warmup: int) -> float | None:
    """Steps per second between the first and the last file of draws of this session."""
    # only whole pieces: more is drawn in the last than is asked for
    drawn = [(at, n - warmup) for at, n in times if n > warmup and not n % CHUNK]
    if len(drawn) < 2:
        return None
    (start, first), (end, last) = drawn[0], drawn[-1]
    return float(chains.statistics["n_steps"][:, first:last].sum() / (end - start))


RESUME = "continue with --resume"


def default_program(scenario: Scenario) -> Program:
    """``systematics`` if the scenario samples an unknown, else ``sky``."""
    return programs.load_program("systematics" if scenario.samples else "sky")


def run_sample(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    program: Program | None = None,
    sampler: Sampler | None = None,
    data: Data | None = None,
    resume: bool = False,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[tuple[SampleResult, ...]]:
    """Sample the posterior of a program, and write the folder in one transaction.

    Several frequencies are sampled one after the other, or together if they share sampled unknowns
    or have a joint prior. Each has its own folder, and their maps are combined into cubes.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    folder : path
        Folder of the results; draws are saved in it while sampling.
    program : Program, optional
        By default :func:`default_program`.
    sampler : Sampler, optional
        By default with the scenario's seed.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to use; if omitted, data are simulated from the scenario.
    resume : bool
        Continue the unfinished run in the folder, or read a finished one.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For positive skies, for an unfinished run in the folder unless ``resume``, and if
        scenario, program, data or folder are invalid.
    """
    scenario = load_scenario(scenario)
    scenario = scenario if data is None else scenario.of_measured()
    if scenario.joint and scenario.spectral.model == "positive":
        raise InputError(
            "lusee-bayes sample integrates skies out, which is not possible for positive ones; use "
            "spectral.model=components, or lusee-bayes map --joint"
        )
    program = program or default_program(scenario)
    sampler = sampler or Sampler(seed=scenario.seed)

    given = {"replace": replace, **told(program, sampler)}

    def draw(
        channels: Mapping[str, Scenario], folder: Path, stages: Stages
    ) -> Sequence[SampleResult]:
        experiments = {
            name: measured_experiment(channel, data, stages, n_draws=sampler.chains * sampler.draws)
            for name, channel in channels.items()
        }
        skies = None
        if scenario.joint and len(channels) > 1:
            of_model = np.array([one.setup.sky.modes for one in experiments.values()])
            skies = scenario.spectral.prior(np.array(scenario.frequencies_mhz), of_model)
        more = {"skies": skies, "resume": resume, "stages": stages}
        return sample_together(experiments, program, sampler, folder, **more)

    def one(
        channel: Scenario, folder: Path, stages: Stages, drawn: SampleResult | None = None
    ) -> RunOutcome[SampleResult]:
        """Write the folder of a channel; sample it, unless its draws are given."""
        with run_folder(folder, SAMPLE, channel, data, program.path, **given) as run:
            made = drawn or draw({"": channel}, run.path, stages)[0]
            return run.write(made, stages, Provenance.of_experiment(made.experiment, data))

    folder, stages = files.user_path(folder), stages or Stages()
    if scenario.single:
        made = one(scenario, folder, stages)
        return replace_fields(made, result=(made.result,))
    channels = {f"{one.frequency_mhz:.15g}MHz": one for one in scenario.channels()}
    treated = registered.present(scenario)
    shared = (k.octaves(one) for k, one in treated if k.treatment(scenario) == "sampled")
    together = scenario.joint or any(shared)
    with run_folder(folder, CUBES, scenario, data, program.path, **given) as run:
        drawn = draw(channels, run.path, stages) if together else [None] * len(channels)
        runs = []
        for (name, channel), made in zip(channels.items(), drawn, strict=True):
            progress = stages if together else Stages(stages.console, verbose=stages.verbose)
            runs.append(one(channel, run.path / name, progress, made))
        results = tuple(each.result for each in runs)
        runs.append(run.write((scenario, results), stages))
        return RunOutcome(results, run.path, [file for each in runs for file in each.files])


def told(program: Program, sampler: Sampler) -> dict[str, object]:
    """What determines draws besides scenario and data, by name."""
    settings = {f"sampler's {name}": value for name, value in asdict(sampler).items()}
    return {"program": f"{program.name} ({program.digest[:12]})", **settings}


def _write_cubes(sampled: tuple[Scenario, tuple[SampleResult, ...]], folder: Path) -> None:
    scenario, results = sampled
    cubes = {name: np.stack([one.maps[name] for one in results]) for name in ("mean", "std")}
    write_cubes(folder, cubes, np.array(scenario.frequencies_mhz), scenario)


SAMPLE_OUTPUTS = (
    Output.netcdf(SAMPLES, lambda run: run.tree),
    Output(
        lambda run, folder: write_map(
            folder / "map.fits", run.maps, run.highest_altitude >= 0, run.experiment.scenario
        )
    ),
    Output.text("summary.csv", lambda run: run.summary.to_csv(index_label="quantity")),
    Output.text("scenario.yaml", lambda run: run.experiment.scenario.to_yaml()),
    Output.model("sampling.json", lambda run: run.figures()),
)

# contents of the folder of a sampled program; a new file is one line here
SAMPLE = RunKind(
    "sample",
    outputs=SAMPLE_OUTPUTS,
    figures={
        "uncertainty": figures.uncertainty,
        "traces": figures.traces,
        "ranks": lambda result: figures.ranks(result.quantities()),
        "pairs": lambda result: figures.pairs(result.quantities()),
    },
    unfinished=CHAINS,
    resume=RESUME,
)

# contents of the folder of several channels, in addition to a folder for each
CUBES = RunKind(
    "sampled cubes",
    outputs=(
        Output(_write_cubes),
        Output.text("scenario.yaml", lambda sampled: sampled[0].to_yaml()),
    ),
    figures={},
    unfinished=CHAINS,
    resume=RESUME,
)


def demand_of_calibration(scenario: Scenario) -> Demand:
    """Resources for simulation-based calibration, in batches that use all processors."""
    return replace_fields(demand_of(scenario, n_draws=BATCH * N_DRAWS), side_by_side=1)


def run_validate(
    scenario: Scenario | str | Path,
    folder: str | Path,
    *,
    name: str = "the scenario",
    sampler: Sampler | None = None,
    simulations: int = 500,
    data: Data | None = None,
    resume: bool = False,
    engine: Engine | None = None,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[ValidationResult]:
    """Check the analytic posterior of a scenario with HMC and with simulated data sets.

    The folder is written in one transaction.

    Parameters
    ----------
    scenario : Scenario, or its file or name
    folder : path
        Folder of the results; draws are saved in it while sampling.
    name : str
        Name of the scenario, for the title.
    sampler : Sampler, optional
        By default with the scenario's seed.
    simulations : int
        Number of data sets for simulation-based calibration.
    data : Visibilities, path, or sequence of them, optional
        Visibilities to use; if omitted, data are simulated from the scenario.
    resume : bool
        Continue the unfinished run in the folder, or test the finished one again.
    engine : Engine, optional
        Where simulated data sets are computed; by default in this process.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For too few draws or simulations, and as :func:`run_sample`.
    """
    scenario, stages = load_scenario(scenario), stages or Stages()
    scenario = scenario if data is None else scenario.of_measured()
    sampler = sampler or Sampler(seed=scenario.seed)
    scenario.require_single("a validation has")
    program = programs.load_program("sky")
    least.require_simulations(simulations)
    least.require_draws(sampler.draws)
    given = {"replace": replace, **told(program, sampler)}
    with run_folder(folder, VALIDATION, scenario, data, program.path, **given) as run:
        n = sampler.chains * sampler.draws
        experiment = measured_experiment(scenario, data, stages, n_draws=n)
        alone = {"": experiment}, program, sampler, run.path
        (drawn,) = sample_together(*alone, resume=resume, stages=stages)
        posterior, model = drawn.inference.posterior, drawn.inference.model
        with stages("comparison"):
            stats = drawn.tree["sample_stats"]
            statistics = stats["diverging"].values, stats["energy"].values
            validated = validate_draws(drawn.skies, posterior, *statistics)
        if engine is not None:
            engine.work_in(run.path)
        more = {"seed": scenario.seed, "engine": engine, "stages": stages}
        ranks = calibrate_sky(model, model, n_simulations=simulations, **more)
        result = ValidationResult(name, drawn, validated, ranks)
        return run.write(result, stages, Provenance.of_experiment(experiment, data))


# contents of the folder of a validation; a new file is one line here
VALIDATION = RunKind(
    "validate",
    outputs=(
        *(Output(lambda r, folder, o=o: o.write(r.sampled, folder)) for o in SAMPLE_OUTPUTS),
        Output.model("validation.json", lambda result: result.summary()),
        Output.text(
            "validation.md", lambda run: render_text("validation.md", result=run, levels=LEVELS)
        ),
    ),
    figures={
        "comparison": lambda result: figures.comparison(result.comparison),
        "calibration": lambda result: figures.rank_statistics(result.ranks),
    },
    unfinished=CHAINS,
    after=("sample",),
    resume=RESUME,
)
