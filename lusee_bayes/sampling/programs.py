"""NumPyro programs: files with a ``model``, their possible arguments, and rules for their sites.

NumPyro runs under JAX's standard rules of types and ranks, the package under strict ones
(:func:`numpyro_promotion`).
"""

import hashlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Float, PRNGKeyArray
from numpyro import handlers
from numpyro.infer import Predictive
from numpyro.infer.util import log_density

from lusee_bayes.core.arrays import Array, on_device
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.files import user_path
from lusee_bayes.core.reading import read_text, require_file
from lusee_bayes.core.version import printable
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.sampling.distributions import Prediction
from lusee_bayes.systematics.systematic import SKY


@contextmanager
def numpyro_promotion() -> Iterator[None]:
    """Allow JAX's standard promotion of types and ranks.

    NumPyro's code mixes types and ranks, whatever rules our code follows. Use this around calls of
    NumPyro, or as the decorator ``@numpyro_promotion()`` of functions that make them.
    """
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


# folders of the package's programs: beside it in a checkout, inside it once installed
PACKAGE = Path(__file__).parents[1]
FOLDERS = (PACKAGE / "models", PACKAGE.parent / "models")

# the site of the data, and the argument that it observes
DATA = "data"
# suffix of a program's site in white coordinates
WHITE_SUFFIX = "_white"

# possible names of a program's arguments: pieces of the model with all systematics in N, ...
PIECES: dict[str, Callable[[LinearGaussian], Any]] = {
    "coupling": lambda model: model.coupling,
    "offset": lambda model: jnp.zeros(model.n_data) if model.offset is None else model.offset,
    "prior": lambda model: model.prior,
    "noise": lambda model: model.noise,
    "fixed_noise": lambda model: model.noise.factor(),
}

# ... and of the experiment: the model without sampled systematics, these systematics, and the
# product and time of every datum
EXPERIMENT_PIECES = ("gaussian", "systematics", "gain_drifts", "instrument", "sources", "layout")


@dataclass(frozen=True)
class Program:
    """A NumPyro model whose arguments are ``data`` and pieces of a model or an experiment.

    Called with ``data=None``, it is the prior predictive. If it returns a LinearGaussian, it has
    integrated the sky out; :func:`collapsed_draws` then draws the sky.

    Attributes
    ----------
    name : str
        Name of its file, without suffix.
    model : callable
        The NumPyro model.
    digest : str
        SHA-256 of its text.
    path : str
        Its file.
    """

    name: str
    model: Callable
    digest: str
    path: str = ""

    def arguments(
        self, model: LinearGaussian, more: Mapping[str, Callable[[], Any]] | None = None
    ) -> dict[str, Any]:
        """Collect the program's arguments except for the data.

        Parameters
        ----------
        model : LinearGaussian
            With all systematics in N; its pieces are ``PIECES``.
        more : mapping of callable, optional
            Functions that make the pieces of an experiment, by name
            (:func:`lusee_bayes.experiment.experiment.program_pieces`).

        Raises
        ------
        InputError
            If the program asks for a missing piece, or for A without the offset although the data
            contain more than the sky.
        """
        names = inspect.signature(self.model).parameters
        if "coupling" in names and "offset" not in names and model.offset is not None:
            raise InputError(
                f"the program '{self.name}' has the argument 'coupling' but not 'offset', and "
                "these data include ground or receivers; add 'offset': coupling @ sky + offset"
            )
        pieces = {name: partial(make, model) for name, make in PIECES.items()} | dict(more or {})
        for name in names:
            if name != DATA and name not in pieces:
                raise InputError(
                    f"'{self.name}' asks for '{name}': give arguments() this piece of an experiment"
                )
        return {name: pieces[name]() for name in names if name != DATA}


def load_program(source: str | Path) -> Program:
    """Load a program.

    Parameters
    ----------
    source : str or Path
        Name of a program that comes with the package, or path of a Python file.

    Raises
    ------
    InputError
        If there is no such program, if it fails to load, or if it asks for an unknown argument.
    """
    path = _find(source)
    text = read_text(path, "a program in Python").encode()
    module = ModuleType(f"lusee_bayes_program_{path.stem}")
    module.__file__ = str(path)
    # compiled from the hashed text, never from a cache of an earlier one; dataclasses look up their
    # module by name
    sys.modules[module.__name__] = module
    with _blaming(f"the program '{path}'", "when it is loaded"):
        exec(compile(text, printable(str(path)), "exec", dont_inherit=True), module.__dict__)
    model = getattr(module, "model", None)
    if not callable(model):
        wrong = f"'{path}' has no function 'model'; a program is def model(..., data=None)"
        raise InputError(wrong)
    asked, pieces = inspect.signature(model).parameters, [*PIECES, *EXPERIMENT_PIECES]
    for name, argument in asked.items():
        if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
            raise InputError(
                f"model in '{path}' has the positional or starred argument '{name}'; arguments are "
                "passed by name: def model(coupling, prior, noise, data=None)"
            )
        if name != DATA and name not in pieces:
            wrong = f"model in '{path}' asks for '{name}', not a piece; {nearest(name, pieces)}"
            raise InputError(wrong)
    if DATA not in asked or asked[DATA].default is not None:
        raise InputError(
            f"model in '{path}' has no argument 'data' with default None; write data=None: given "
            "data are observed, otherwise data are drawn"
        )
    return Program(path.stem, model, hashlib.sha256(text).hexdigest(), str(path))


def _find(source: str | Path) -> Path:
    own = {path.stem: path for folder in reversed(FOLDERS) for path in folder.glob("*.py")}
    if str(source) in own:
        return own[str(source)]
    path, programs = user_path(source), ", ".join(sorted(own))
    if path.suffix == ".py":
        return require_file(path, "program", f"the package has {programs}")
    raise InputError(f"no program '{source}': give the path of a Python file, or one of {programs}")


def traced(program: Callable, arguments: Mapping[str, Any]) -> tuple[dict[str, dict], Any]:
    """Return the sites of a program by name, and its result, without running it."""
    traces = []

    def run(arguments):
        with handlers.trace() as sites:
            returned = handlers.seed(program, 0)(**arguments)
        traces.append((dict(sites), returned))

    with numpyro_promotion():
        eqx.filter_eval_shape(run, dict(arguments))
    return traces[0]


def is_collapsed(program: Program, arguments: dict[str, Any], data: Array) -> bool:
    """Return whether the program integrates the sky out: its model returns a LinearGaussian."""
    return isinstance(traced(program.model, {**arguments, DATA: data})[1], LinearGaussian)


def predicts(program: Callable, arguments: dict, kind: type = Prediction) -> bool:
    """Return whether a program has a site of a kind of distribution.

    With CorrelatedNormal or TimesStudentT (Predictions), it samples everything that they depend on,
    and its density needs only matrix products.
    """
    sites = traced(program, arguments)[0].values()
    return any(site["type"] == "sample" and isinstance(site["fn"], kind) for site in sites)


def latent_sites(program: Callable, arguments: dict) -> list[str]:
    """Return the names of a program's latent sites: sampled, but not observed."""
    return latent_of(traced(program, arguments)[0])


def latent_of(sites: Mapping[str, dict]) -> list[str]:
    """Return the names of the latent sites among a program's sites."""
    return [n for n, s in sites.items() if s["type"] == "sample" and not s["is_observed"]]


@numpyro_promotion()
def collapsed_draws(
    program: Program,
    arguments: dict[str, Any],
    data: Float[Array, " data"],
    sites: dict[str, np.ndarray],
    key: PRNGKeyArray,
    skies: Float[np.ndarray, "chains draws modes"] | None = None,
) -> Float[np.ndarray, "chains draws n"]:
    """Draw the sky exactly, given each draw of the other sites; or simulate data of drawn skies.

    Parameters
    ----------
    program : Program
        A program that integrates the sky out.
    arguments : dict
        Its arguments, without the data.
    data : (data,) array
        d, in K.
    sites : dict of (chains, draws, ...) array
        Draws by site.
    key : PRNG key
        Key for the skies, or for the noise.
    skies : (chains, draws, modes) array, optional
        Skies drawn earlier, in K.

    Returns
    -------
    (chains, draws, modes) or (chains, draws, data) array
        Skies; or, if ``skies`` are given, their data with new noise. In K.
    """

    def model():
        gaussian = program.model(**arguments, data=jnp.asarray(data))
        exact = on_device(gaussian.condition(data).posterior).sample(numpyro.prng_key())
        sky = numpyro.sample("drawn sky", numpyro.distributions.Delta(exact, event_dim=1))
        replicated = gaussian.predict(sky) + gaussian.noise.sample(numpyro.prng_key())
        numpyro.deterministic("drawn data", replicated)

    drawn = "drawn sky" if skies is None else "drawn data"
    given = sites if skies is None else {**sites, "drawn sky": skies}
    return np.asarray(Predictive(model, given, batch_ndims=2, return_sites=[drawn])(key)[drawn])


# names that samples.nc reserves: of dimensions, constants and statistics
TAKEN = re.compile(
    "chain|draw|mode|datum|ell|m|product|time|truth|analytic_mean|analytic_std|prior_std|lp|energy|"
    "diverging|acceptance_rate|step_size|n_steps"
)
# names that netCDF, summaries and tables accept without quotes
NAME = re.compile(r"[^\W\d][\w.\-]*")


def require_sampleable(
    program: Program, arguments: dict[str, Any], data: Float[Array, " data"], n_modes: int
) -> list[str]:
    """Check that a program can be sampled, and that it gives draws of the sky.

    The program is traced, not run: no density is computed.

    Parameters
    ----------
    program : Program
    arguments : dict
        Its arguments, without the data.
    data : (data,) array
        d, in K.
    n_modes : int
        Number of harmonic coefficients of the sky.

    Returns
    -------
    list of str
        The sites that it samples.

    Raises
    ------
    InputError
        If it fails when called with or without data, if a site cannot be sampled or stored, if it
        does not observe ``data``, or if it neither has a site for the sky nor returns a
        LinearGaussian to draw it from.
    """
    who, given = f"the program '{program.path or program.name}'", {**arguments, DATA: data}
    with _blaming(who, "when it is called"):
        sites, returned = traced(program.model, given)
    latent = latent_of(sites)
    for name, site in sites.items():
        if site["type"] in ("sample", "deterministic"):
            _require_site(name, site, name in latent, who)
    if DATA not in sites or DATA in latent:
        raise InputError(f"{who} has no observed site 'data'; sample('data', ..., obs=data)")
    _require_shape(sites[DATA], data.shape, f"{who} observes")
    if not latent:
        raise InputError(f"{who} has no latent site, so that nothing is sampled")
    if SKY in sites:
        what = "samples" if SKY in latent else "computes"
        _require_shape(sites[SKY], (n_modes,), f"{who} {what}")
    elif not isinstance(returned, LinearGaussian):
        raise InputError(
            f"{who} has no site 'sky' and returns no LinearGaussian to draw the sky from; do either"
        )
    with _blaming(who, "when it is called with data=None"):
        drawn = latent_sites(program.model, {**arguments, DATA: None})
    if DATA not in drawn:
        wrong = f"{who} draws no data if data=None; sample('data', ..., obs=data) in both cases"
        raise InputError(wrong)
    if differing := {*drawn} ^ {*latent, DATA}:
        why = f"{who} samples '{min(differing)}' only with data, or only without; sample it in both"
        raise InputError(why)

    def slope(arguments):
        trace = handlers.trace(handlers.seed(program.model, 0)).get_trace(**arguments)
        values = {name: trace[name]["value"] for name in latent}
        return jax.grad(lambda v: log_density(program.model, (), arguments, v)[0])(values)

    with _blaming(who, "when its density is differentiated"), numpyro_promotion():
        eqx.filter_eval_shape(slope, given)
    return latent


@contextmanager
def _blaming(who: str, doing: str) -> Iterator[None]:
    """Turn any error of a user's program into an InputError that names the program and line."""
    try:
        yield
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if f"'{frame.filename}'" in who]
        at = f" (line {lines[-1]})" if lines else ""
        raise InputError(f"{who} fails {doing}{at}: {type(error).__name__}: {error}") from error


def _require_site(name: str, site: dict[str, Any], latent: bool, who: str) -> None:
    if not NAME.fullmatch(name):
        wrong = f"{who} has a site '{name}'; use letters, digits, '_', '.' and '-', a letter first"
        raise InputError(wrong)
    if TAKEN.fullmatch(name) or name.endswith(WHITE_SUFFIX):
        raise InputError(f"{who} has a site '{name}', a reserved name; rename it")
    if latent and site["fn"].support.is_discrete:
        raise InputError(
            f"{who} has the discrete site '{name}'; Hamiltonian Monte Carlo needs continuous ones: "
            "sum over it, or use a continuous distribution"
        )
    if [*map(jnp.iscomplexobj, jax.tree.leaves(site["value"]))] != [False]:
        raise InputError(f"{who} has the complex site '{name}'; use one for each real part")


def _require_shape(site: dict[str, Any], shape: tuple[int, ...], what: str) -> None:
    density = tuple(site["fn"].shape()) if site["type"] == "sample" else shape
    for given in (jnp.shape(site["value"]), density):
        if given != shape:
            raise InputError(f"{what} '{site['name']}' with shape {given}; expected {shape}")
