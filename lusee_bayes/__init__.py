"""Bayesian map-making for LuSEE-Night: from visibilities to a posterior over sky maps.

::

    d = A m + n,    m ~ N(0, S),    n ~ N(0, N)

The folders are the symbols, then what is done with them; each imports only from those above it. ::

    core          checks, harmonics, rotations, linear algebra, files, progress
    sky           m and S: skies and priors
    instrument    A and d: beams, observation, coupling, visibilities
    flight        sessions of the spectrometer, made into visibilities
    noise         N: covariances and the errors that they are made of
    linear        p(m | d) in closed form
    judge         do data and model agree, and does the error bar cover
    priors        families of priors, and how they are learned
    systematics   unknowns that are marginalised into N or sampled
    sampling      p(m | d) by Hamiltonian Monte Carlo
    experiment    a YAML scenario turned into A, S, N and data
    results       what a run has found
    report        figures and pages
    paper         the reference paper's cases, claims and figures
    runs          one function for each command: it computes, and writes its folder whole
    cli           the command line

``LinearGaussian(A, S, N).condition(d).posterior`` is the :class:`Posterior`: mean, std, draws.
Importing the package switches JAX to 64 bit: Lambda's condition number is about 1e10.
"""

import os
import sys

import lazy_loader

# NumPy, SciPy and JAX have threads of their own. Those of OpenBLAS wait for more work on the
# processor, by default for longer than the others' work takes: with 2^20 cycles, a thousandth of a
# second, a map is made in two thirds of the time
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "20")
# XLA warns of every program that it finds in the cache, and calls it an error on some processors;
# what does go wrong is raised
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# JAX is not imported for that: --help and completion answer without it
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)

# every public name stands in __init__.pyi; each is imported when it is first used, since JAX,
# healpy, lunarsky and xarray take seconds together
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
