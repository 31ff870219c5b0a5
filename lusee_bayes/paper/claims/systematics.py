"""The paper on gain drifts and beam errors (sections 4.3, 4.4, appendix A)."""

from __future__ import annotations

from lusee_bayes.paper.claims.base import (
    Cases,
    Claim,
    Verdict,
    cross,
    entry,
    first_below,
    grade,
    registrar,
    snr_ratio,
)

CLAIMS: list[Claim] = []
claim = registrar(CLAIMS)


@claim(
    "4.3, 5",
    "gain drifts of 1 % (and 0.1 %), marginalised, leave the target quality",
    "marginalised drifts cost the weak intermediate multipoles, not the large scales",
)
def _gain_one_percent(cases: Cases) -> Verdict:
    return kept(cases, ["gain_1e-2", "gain_1e-3"])


@claim(
    "5",
    "gain drifts of 1-10 % are tolerable",
    "the larger drifts leave too little of the weak intermediate multipoles",
)
def _gain_ten_percent(cases: Cases) -> Verdict:
    return kept(cases, ["gain_1e-2", "gain_1e-1"])


def kept(cases: Cases, names: list[str]) -> Verdict:
    """Whether cases keep rho > 0.9 to ell 10 (partly: to 5) and ell_cross within 10."""
    low = [first_below(cases[name]["rho"].values, 0.9) for name in names]
    first = [cross(cases[name]) for name in names]
    fiducial = cross(cases["fiducial"])
    near = all(abs(ell - fiducial) <= 10 for ell in first)
    text = ", ".join(
        f"{name}: rho < 0.9 from ell {a}, SNR < 1 from {b}"
        for name, a, b in zip(names, low, first, strict=True)
    )
    return grade(f"{text} (fiducial {fiducial})", near and min(low) >= 10, min(low) >= 5)


@claim(
    "app. A",
    "for sigma_g << 1 the term of N_gain linear in C_g dominates",
    "the drifts are not small",
)
def _linear_gain(cases: Cases) -> Verdict:
    # an auto: 4 C_g linear, 2 C_g^2 quadratic
    ratio = entry(cases["gain_1e-2"], "noise.gain.sigma") ** 2 / 2
    return grade(f"quadratic over linear term of the autos {ratio:.1e}", ratio < 1e-2, ratio < 0.5)


@claim(
    "4.3, 4.4",
    "ignoring gain or beam errors leads to artefacts and loss of fidelity; marginalising mends it",
    "the errors are too small to matter",
)
def _marginalising(cases: Cases) -> Verdict:
    pairs = [("gain_ignored", "gain_1e-2"), ("beam_ignored", "beam_4MHz")]
    loss = [cross(cases[bad]) < 0.5 * cross(cases[good]) for bad, good in pairs]
    text = ", ".join(
        f"{bad}: SNR < 1 from ell {cross(cases[bad])}, marginalised {cross(cases[good])}"
        for bad, good in pairs
    )
    return grade(text, all(loss), any(loss))


BURIED = (
    "an error of several per cent is hundreds of times the radiometer noise in as many directions "
    "of data space as there are modes; what is left constrains the weak multipoles less"
)
FRINGES = (
    "the beam of a thin monopole 2 m above layered ground is not HFSS's: its change with "
    "frequency is set by the ground's interference fringes"
)


@claim("4.4", "a 4 MHz shift is a beam RMSD of about 10 %", FRINGES)
def _beam_4mhz(cases: Cases) -> Verdict:
    percent = 100 * cases["beam_4MHz"].attrs["beam_rms_difference"]
    return grade(f"{percent:.1f} %", 7 <= percent <= 13, 5 <= percent <= 20)


@claim("4.4", "a 0.4 MHz shift is a beam RMSD of about 1 %", FRINGES)
def _beam_04mhz(cases: Cases) -> Verdict:
    percent = 100 * cases["beam_0.4MHz"].attrs["beam_rms_difference"]
    return grade(f"{percent:.1f} %", 0.7 <= percent <= 1.3, 0.5 <= percent <= 2)


@claim(
    "4.4",
    "beam errors leave ell_cross where the fiducial has it",
    BURIED,
)
def _beam_cross(cases: Cases) -> Verdict:
    first = [cross(cases[name]) for name in ("beam_4MHz", "beam_0.4MHz")]
    fiducial = cross(cases["fiducial"])
    off = max(abs(ell - fiducial) for ell in first)
    return grade(
        f"SNR < 1 from ell {first[0]} (4 MHz), {first[1]} (0.4 MHz), fiducial {fiducial}",
        off <= 3,
        off <= 10,
    )


@claim("4.4", "beam errors make SNR poorer at intermediate scales", "the errors hardly matter")
def _beam_snr(cases: Cases) -> Verdict:
    ratio = [snr_ratio(cases, name, 5, 20) for name in ("beam_4MHz", "beam_0.4MHz")]
    return grade(
        f"SNR over the fiducial's, median of ell 5-20: {ratio[0]:.2f} (4 MHz), {ratio[1]:.2f} "
        "(0.4 MHz)",
        max(ratio) < 0.9,
        min(ratio) < 0.9,
    )


@claim(
    "5",
    "in situ beams known to about 10 % suffice",
    BURIED,
)
def _beam_accuracy(cases: Cases) -> Verdict:
    return kept(cases, ["beam_4MHz"])
