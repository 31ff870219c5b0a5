"""Bayesian map-making for LuSEE-Night: from visibilities to a posterior over sky maps.

::

    d = A m + n,    m ~ N(0, S),    n ~ N(0, N)

First come folders for the symbols, then folders that use them; each imports only from those above::

    core          checks, harmonics, rotations, linear algebra, files, progress
    sky           m and S: skies and priors
    instrument    A and d: beams, observation, coupling, visibilities
    flight        spectrometer sessions, reduced to visibilities
    noise         N: covariances and the errors behind them
    linear        p(m | d) in closed form
    judge         whether data and model agree, and error bars cover the truth
    priors        families of priors, and how they are learned
    systematics   unknowns that are marginalised into N or sampled
    sampling      p(m | d) by Hamiltonian Monte Carlo
    experiment    a YAML scenario turned into A, S, N and data
    results       results of a run
    report        figures and pages
    paper         the reference paper's cases, claims and figures
    runs          one function per command: computes, and writes its folder whole
    cli           the command line

``LinearGaussian(A, S, N).condition(d).posterior`` is the :class:`Posterior`: mean, std, draws.
Importing the package switches JAX to 64 bit: Lambda's condition number is about 1e10.
"""

import os
import sys

import lazy_loader

# NumPy, SciPy and JAX each have their own threads. Idle threads of OpenBLAS keep the processor
# busy, by default for longer than the other libraries' work takes. With a limit of 2^20 cycles,
# about a millisecond, a map takes two thirds of the time
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "20")
# XLA warns about every program that it finds in the cache, on some processors as an error; real
# errors are raised as exceptions
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# set without importing JAX, since --help and completion do not need it
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)

# __init__.pyi lists all public names; each is imported when first used, since JAX, healpy, lunarsky
# and xarray together take seconds
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
