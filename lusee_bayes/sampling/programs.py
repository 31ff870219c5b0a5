"""NumPyro programs: files with a ``model``, what they can ask for, and what their sites are.

NumPyro runs under JAX's standard rules of types and ranks, the package under strict ones
(:func:`numpyro_promotion`).
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Key, PRNGKeyArray
from numpyro import handlers

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.files import user_path
from lusee_bayes.core.reading import read_text, require_file
from lusee_bayes.core.version import printable
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.sampling.distributions import Prediction


@contextmanager
def numpyro_promotion() -> Iterator[None]:
    """Allow JAX's standard promotion of types and ranks.

    NumPyro's own code mixes types and ranks, whatever rules are set for ours. Use it around calls
    of NumPyro, or as the decorator ``@numpyro_promotion()`` of functions that make them.
    """
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


# the programs that come along: beside the package in a checkout, inside it once installed
PACKAGE = Path(__file__).parents[1]
FOLDERS = (PACKAGE / "models", PACKAGE.parent / "models")

# what a program's arguments may be called: pieces of the model with all systematics in N, ...
PIECES: dict[str, Callable[[LinearGaussian], Any]] = {
    "coupling": lambda model: model.coupling,
    "offset": lambda model: jnp.zeros(model.n_data) if model.offset is None else model.offset,
    "prior": lambda model: model.prior,
    "noise": lambda model: model.noise,
    "fixed_noise": lambda model: model.noise.factor(),
}

# ... and of the experiment: the model without those that are to be sampled, they themselves, and
# the product and time of every datum
EXPERIMENT_PIECES = (
    "gaussian",
    "systematics",
    "gain_drifts",
    "instrument",
    "sources",
    "log_normal",
    "layout",
)


@dataclass(frozen=True)
class Program:
    """A NumPyro model whose arguments are ``data`` and pieces of a model or an experiment.

    Called with ``data=None`` it is the prior predictive. If it returns a LinearGaussian, it has
    integrated the sky out; :func:`collapsed_draws` then draws it.

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
        """Collect what the program asks for; all but the data.

        Parameters
        ----------
        model : LinearGaussian
            With all systematics in N; its pieces are ``PIECES``.
        more : mapping of callable, optional
            What makes the pieces of an experiment, by name
            (:func:`lusee_bayes.experiment.experiment.program_pieces`).

        Raises
        ------
        InputError
            If the program asks for a piece that is not there, or for A alone where the data hold
            more than the sky.
        """
        found, names = {}, inspect.signature(self.model).parameters
        if "coupling" in names and "offset" not in names and model.offset is not None:
            raise InputError(
                f"the program '{self.name}' asks for 'coupling' alone, and these data hold ground "
                "or receivers besides the sky; add the argument 'offset', and coupling @ sky + "
                "offset"
            )
        for name in names:
            if name in PIECES:
                found[name] = PIECES[name](model)
            elif name != "data":
                if more is None or name not in more:
                    raise InputError(
                        f"the program '{self.name}' asks for '{name}', a piece of an experiment; "
                        "give arguments() the experiment's pieces"
                    )
                found[name] = more[name]()
        return found


def program_names() -> list[str]:
    """Return the names of the programs that come with the package."""
    return sorted({path.stem for folder in FOLDERS for path in folder.glob("*.py")})


def load_program(source: str | Path) -> Program:
    """Load a program.

    Parameters
    ----------
    source : str or Path
        Name of a program that comes with the package, or path of a Python file.

    Raises
    ------
    InputError
        If there is none, if it cannot be run, or if it asks for something unknown.
    """
    path = _find(source)
    text = read_text(path, "a program in Python").encode()
    module = ModuleType(f"lusee_bayes_program_{path.stem}")
    module.__file__ = str(path)
    # compiled from the text that is hashed, never from a cache of an earlier one; dataclasses look
    # their module up by name
    sys.modules[module.__name__] = module
    try:
        exec(compile(text, printable(str(path)), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:  # whatever a user's file may raise: not our failure
        del sys.modules[module.__name__]
        kind = type(error).__name__
        raise InputError(f"the program '{path}' does not run: {kind}: {error}") from error
    model = getattr(module, "model", None)
    if not callable(model):
        raise InputError(
            f"'{path}' has no function 'model'; a program is def model(..., data=None)"
        )
    asked = inspect.signature(model).parameters
    for name, argument in asked.items():
        if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
            raise InputError(
                f"model in '{path}' takes '{name}' by position, or as many as come; every argument "
                "is given by its name: def model(coupling, prior, noise, data=None)"
            )
    if "data" not in asked:
        raise InputError(f"model in '{path}' has no argument 'data'; the data could not enter it")
    if asked["data"].default is not None:
        raise InputError(
            f"model in '{path}' has no data=None; without data, data are drawn from it"
        )
    for name in asked:
        known = [*PIECES, *EXPERIMENT_PIECES]
        if name != "data" and name not in known:
            raise InputError(
                f"model in '{path}' asks for '{name}', which is neither data nor a piece; "
                f"{nearest(name, known)}"
            )
    return Program(path.stem, model, hashlib.sha256(text).hexdigest(), str(path))


def _find(source: str | Path) -> Path:
    if str(source) in program_names():
        return next(f / f"{source}.py" for f in FOLDERS if (f / f"{source}.py").exists())
    path = user_path(source)
    if path.suffix == ".py":
        own = f"the package has {', '.join(program_names())}"
        return require_file(path, "program", own)
    raise InputError(
        f"no program '{source}': give the path of a Python file, or one of "
        f"{', '.join(program_names())}"
    )


def traced(program: Callable, arguments: Mapping[str, Any]) -> tuple[dict[str, dict], Any]:
    """Return the sites of a program by name, and what it returns, without running it."""
    found = []

    def run(dynamic):
        with handlers.trace() as sites:
            returned = handlers.seed(program, 0)(**eqx.combine(dynamic, static))
        found.append((dict(sites), returned))

    dynamic, static = eqx.partition(dict(arguments), eqx.is_array)
    with numpyro_promotion():
        jax.eval_shape(run, dynamic)
    return found[0]


def is_collapsed(program: Program, arguments: dict[str, Any], data: Array) -> bool:
    """Tell whether the program integrates the sky out: its model returns a LinearGaussian."""
    return isinstance(traced(program.model, {**arguments, "data": data})[1], LinearGaussian)


def predicts(program: Callable, arguments: dict, kind: type[Prediction] = Prediction) -> bool:
    """Tell whether a program has a site CorrelatedNormal or TimesStudentT, or of one ``kind``.

    It then samples everything that they depend on, and its density needs matrix products only.
    """
    return any(isinstance(site["fn"], kind) for site in _sampled(program, arguments))


def latent_sites(program: Callable, arguments: dict) -> list[str]:
    """Return the names of the sites that a program samples and does not observe."""
    return [site["name"] for site in _sampled(program, arguments) if not site["is_observed"]]


def _sampled(program: Callable, arguments: dict) -> list[dict]:
    return [s for s in traced(program, arguments)[0].values() if s["type"] == "sample"]


def side_by_side(draws: Any) -> Any:
    """Put the draws of all chains of a tree of (chains, draws, ...) arrays one after the other."""
    return jax.tree.map(lambda v: jnp.asarray(v).reshape(-1, *v.shape[2:]), draws)


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
        One that integrates the sky out.
    arguments : dict
        What it asks for, without the data.
    data : (data,) array
        d, in K.
    sites : dict of (chains, draws, ...) array
        Draws by site.
    key : PRNG key
        Of the skies, or of the noise.
    skies : (chains, draws, modes) array, optional
        Those that were drawn, in K.

    Returns
    -------
    (chains, draws, modes) or (chains, draws, data) array
        Skies; or, of skies that are given, data with new noise. In K.
    """
    shape = next(iter(sites.values())).shape[:2]
    keys = jax.random.split(key, shape[0] * shape[1])
    rows = _draw(program, arguments, jnp.asarray(data), *side_by_side((sites, skies)), keys)
    return np.asarray(rows).reshape(*shape, -1)


@eqx.filter_jit
def _draw(
    program: Program,
    arguments: dict[str, Any],
    data: Float[Array, " data"],
    sites: dict[str, Array],
    skies: Float[Array, "draws modes"] | None,
    keys: Key[Array, " draws"],
) -> Float[Array, "draws n"]:
    """Skies, or data where skies are given, one draw after the other."""

    def one(inputs):
        values, sky, key = inputs
        model = handlers.substitute(handlers.seed(program.model, 0), values)
        gaussian = model(**arguments, data=data)
        if sky is None:
            return gaussian.condition(data).sample(key)
        return gaussian.predict(sky) + gaussian.noise.sample(key)

    return jax.lax.map(one, (sites, skies, keys))
