"""What is in the samples of a program."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.sampling.datatree import read_datatree


def describe_samples(path: Path) -> str:
    """Draws of a program."""
    tree = read_datatree(path)
    posterior, statistics = tree["posterior"], tree["sample_stats"]
    sites = ", ".join(f"{name} {v.shape[2:]}" for name, v in posterior.data_vars.items())
    return "\n".join(
        [
            f"{path}: {posterior.sizes['chain']} x {posterior.sizes['draw']} draws of the program "
            f"{tree.attrs['program']} at {float(tree.attrs['frequency_mhz']):g} MHz",
            f"  sites: {sites}",
            f"  {int(statistics['diverging'].sum())} divergences, "
            f"{float(statistics['n_steps'].mean()):.1f} steps a trajectory",
            f"  groups: {', '.join(tree.children)}",
        ]
    )
