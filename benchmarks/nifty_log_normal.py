"""The mode of a log-normal sky by NIFTy.re, and by `find_mode`: the same energy, from the template.

NIFTy is no dependency: `pip install nifty[re]` into an environment of its own beside this package.

    python benchmarks/nifty_log_normal.py [LMAX] [ROUNDS]
"""

import sys
import time

import jax
import jax.numpy as jnp
import nifty.re as jft
import numpy as np

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_device
from lusee_bayes.sampling.log_normal.gauss_newton import find_mode

lmax, rounds = (int(text) for text in (*sys.argv[1:], "16", "6")[:2])
PRIOR = "prior={model: lognormal, sources: false, amplitude: 0.04, tilt: -2.5}"
experiment = lb.build(lb.load_scenario("fiducial", [f"lmax={lmax}", PRIOR]))
mode = experiment.positive.posterior.mode
sky, information = on_device(mode.sky), mode.information

started = time.perf_counter()
found = find_mode(mode.sky, information.recentred(mode.sky.modes(np.zeros(sky.size))))
ours = time.perf_counter() - started

# M = H^T H: the information of the data as data of their own
values, vectors = np.linalg.eigh(np.asarray(information.matrix))
kept = values > values[-1] * 1e-15
root = (vectors[:, kept] * np.sqrt(values[kept])).T
reference = np.asarray(information.reference)
data = (vectors[:, kept] / np.sqrt(values[kept])).T @ np.asarray(information.vector)


def response(unknowns):
    """Data of a sky, less those of the reference."""
    return jnp.asarray(root) @ (sky.modes(unknowns["u"]) - reference)


def energy(white):
    """Half of chi^2 and of the prior's."""
    off = data - np.asarray(response({"u": jnp.asarray(white)}))
    return 0.5 * float(off @ off + white @ white)


shape = jax.ShapeDtypeStruct((sky.size,), jnp.float64)
likelihood = jft.Gaussian(jnp.asarray(data)).amend(jft.Model(response, domain={"u": shape}))
minimiser = {
    "name": None,
    "xtol": 1e-10,
    "absdelta": 1e-6,
    "maxiter": 200,
    "cg_kwargs": {"name": None, "maxiter": 2000},
}
started = time.perf_counter()
samples, _ = jft.optimize_kl(
    likelihood,
    jft.Vector({"u": jnp.zeros(sky.size)}),
    key=jax.random.key(1),
    n_total_iterations=rounds,
    n_samples=0,
    draw_linear_kwargs={"cg_name": None, "cg_kwargs": {"maxiter": 2000}},
    kl_kwargs={"minimize_kwargs": minimiser},
    sample_mode="linear_resample",
)
theirs = time.perf_counter() - started
print(f"lmax {lmax}, {sky.size} unknowns; M from {values[kept][0]:.1e} to {values[-1]:.1e} / K^2")
rows = {
    "find_mode": (ours, np.asarray(found.white)),
    f"NIFTy.re, {rounds} rounds": (theirs, np.asarray(samples.pos.tree["u"])),
}
for name, (seconds, white) in rows.items():
    print(f"{name:20s} {seconds:8.2f} s, energy {energy(white):.2f}")
