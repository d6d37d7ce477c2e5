"""Report the draws of a posterior: an entry of fit.json, the file posterior.csv, and lines on the terminal."""

from pathlib import Path

import numpy as np

from fitting.fits.posterior import Posterior
from liverjax.core.files import write_rows
from liverjax.core.struct import Content

#: Quantiles that are reported.
QUANTILES = (0.025, 0.5, 0.975)


def summary(p: Posterior) -> Content:
    """Return the entry `posterior` of fit.json."""
    flat = p.draws.reshape(-1, p.draws.shape[-1])
    rows = zip(p.names, flat.mean(axis=0), flat.std(axis=0, ddof=1), *np.quantile(flat, QUANTILES, axis=0), strict=True)
    evidence = p.chains.log_evidence
    return {
        "chains": len(p.draws),
        "draws_per_chain": p.draws.shape[1],
        "file": "posterior.csv",
        "numbers": {
            name: {"mean": mean, "standard_deviation": sd, "median": median, "interval_95": [low, high], "r_hat": r}
            for (name, mean, sd, low, median, high), r in zip(rows, p.r_hat.tolist(), strict=True)
        },
        "largest_r_hat": float(p.r_hat.max()),
        "prior": p.prior,
        "log_evidence": float(evidence.mean()),
        "log_evidence_standard_error": float(evidence.std(ddof=1) / np.sqrt(len(evidence))),
        "acceptance": p.chains.acceptance,
        "moves": p.chains.moves,
        "simulated": p.simulated,
        "run_time_s": p.seconds,
    }


def write_draws(path: Path, p: Posterior) -> None:
    """Write a row for each draw: the index of its chain, then the parameters in SI units, with the names of
    fit.json."""
    rows = np.column_stack([np.repeat(np.arange(len(p.draws)), p.draws.shape[1]), p.draws.reshape(-1, len(p.names))])
    header = ",".join(["chain", *p.names])
    write_rows(path, rows, header, ["%d"] + ["%.9g"] * len(p.names))


def table(p: Posterior) -> str:
    """Return lines to print: medians and 95 % intervals of all parameters."""
    flat = p.draws.reshape(-1, p.draws.shape[-1])
    low, middle, high = np.quantile(flat, QUANTILES, axis=0)
    chains, count, _ = p.draws.shape
    rows = [f"posterior: {chains} chains of {count}, R-hat up to {p.r_hat.max():.3f}, {p.seconds:.2g} s"]
    rows += [
        f"{name:22s} {m:10.4g}   95 % {a:.4g} to {b:.4g}"
        for name, m, a, b in zip(p.names, middle, low, high, strict=True)
    ]
    if p.simulated:
        count, apart = p.simulated["draws"], p.simulated["largest_difference"]
        rows.append(f"{count:.0f} draws were also simulated: their log density differs by {apart:.2g} at most")
    return "\n".join(rows)
