"""Error of the rigs against run time: whole cylinders and graded sectors, linear and quadratic elements, K/mu.

The tests are tension, a punch of 0.4 of the radius, and creep of a neo-Hookean cylinder glued to its plates, at small
strain. They are compared with tests/rig_values.json. Its converged numbers come from a program that shares no code with
this one (axisymmetric, small strain, `experiments/sources/axisymmetric_reference.py`).
``python -m experiments stability_rigs`` writes results/stability_rigs.json;
``python -m experiments.stability.stability_rigs tension meshes`` runs these parts again.
"""

import json
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import liverjax as lj
from experiments.common import RESULTS, ROOT, either, plain_ticks, save
from fitting.rigs import glued
from liverjax.core import status
from liverjax.core.plotting import COLOURS

R, MU = 0.01, 800.0
#: A small strain. In the difference of forward and backward steps, the term of second order in the strain cancels.
PART = 1e-3
TESTS = ("tension", "punch", "creep")
VALUES = json.loads((ROOT / "tests" / "rig_values.json").read_text())["rows"]
RATIOS = either((3.0, 20.0, 100.0, 1e4), (20.0,))
ASPECTS = either((0.2, 0.5, 1.0, 2.0, 5.0), (1.0,))


def known(test: str, aspect: float, ratio: float) -> float:
    """Return the converged number."""
    keys = {"test": test, "height_over_radius": aspect, "bulk_over_shear": ratio}
    rows = [r for r in VALUES if keys.items() <= r.items() and r.get("punch_radius", 0.4) == 0.4]
    return rows[0]["value"]


def rigs(test: str, aspect: float, cells: glued.Cells) -> tuple[glued.Rig, float]:
    """Return the rig, with a step forward and a step back, and the unit that its reading is divided by."""
    height, forth_and_back = aspect * R, np.array([1.0, -1.0]) * PART * R
    if test == "tension":
        return glued.tension(R, height, 1.0, forth_and_back / height, cells), MU * R * PART * R
    if test == "punch":
        return glued.indentation(R, height, 0.4 * R, 1.0, forth_and_back, cells), -MU * R * PART * R
    return glued.creep(R, height, 1.0, 1, PART * MU, cells), PART * R


def row(test: str, aspect: float, cells: glued.Cells, ratios: tuple[float, ...]) -> list[dict[str, Any]]:
    """Return errors and run times of a rig at some K/mu, with one compiled program."""
    rig, unit = rigs(test, aspect, cells)
    law = lj.laws.NeoHookean(mu=jnp.asarray(MU), bulk=jnp.asarray(MU))
    begin = time.perf_counter()
    program = jax.jit(lambda law: glued.read(rig, law, None)).lower(law).compile()
    compiling = time.perf_counter() - begin
    found = []
    for ratio in ratios:
        own = lj.laws.NeoHookean(mu=jnp.asarray(MU), bulk=jnp.asarray(ratio * MU))
        seconds = []
        for _ in range(3):
            begin = time.perf_counter()
            readings, codes = jax.block_until_ready(program(own))
            seconds.append(time.perf_counter() - begin)
        value = float(readings[0] - readings[1]) / 2 if len(readings) > 1 else float(readings[0])
        found.append(
            {
                "test": test,
                "height_over_radius": aspect,
                "bulk_over_shear": ratio,
                "cells": {k: v for k, v in cells._asdict().items() if v is not None},
                "elements": rig.scene.mesh.number_of_elements,
                "nodes": rig.scene.mesh.number_of_nodes,
                "error": value / unit / known(test, aspect, ratio) - 1,
                "code": status.NAMES[int(status.most_severe(codes))],
                "run_s": float(np.median(seconds)) / len(readings),
                "compile_s": compiling,
            }
        )
        print(found[-1], flush=True)
    return found


def choices() -> list[tuple[str, glued.Cells]]:
    """Return meshes to compare: whole cylinders with one cell size, and sectors half, equally and twice as fine as the
    default.
    """
    default, made = glued.Cells(), []
    for order, sizes, fine in ((1, (3, 6), (1.0, 2.0)), (2, (3,), (0.5, 1.0, 2.0))):
        made += [(f"whole, order {order}", default._replace(size=R / n, order=order)) for n in either(sizes, (3,))]
        for finer in either(fine, (1.0,)):
            graded = {"rim": default.rim / finer**2, "edge": default.edge / finer**2, "growth": default.growth / finer}
            made.append((f"sector, order {order}", default._replace(order=order, **graded)))
    return made


def main(wanted: list[str]) -> None:
    """Run the default mesh at every shape, then other meshes at one shape; or only the named parts."""
    file = RESULTS / "stability_rigs.json"
    found: dict[str, list] = {"default": [], "meshes": []}
    if wanted and file.is_file():
        found = json.loads(file.read_text())
    wanted = wanted or [*TESTS, "meshes"]
    for test in (t for t in TESTS if t in wanted):
        found["default"] = [r for r in found["default"] if r["test"] != test]
        for aspect in ASPECTS:
            found["default"] += row(test, aspect, glued.Cells(), RATIOS)
            save("stability_rigs", found)
    if "meshes" in wanted:
        found["meshes"] = []
        for test in TESTS:
            for name, cells in choices():
                found["meshes"] += [{"mesh": name} | r for r in row(test, 1.0, cells, either((20.0, 1e4), (20.0,)))]
                save("stability_rigs", found)
    save("stability_rigs", found, _figure(found["meshes"]))


def _figure(rows: list[dict]) -> plt.Figure:
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.1), layout="constrained", sharey=True)
    for axis, test in zip(axes, TESTS, strict=True):
        for name, colour in zip(dict.fromkeys(r["mesh"] for r in rows), COLOURS, strict=False):
            for ratio, style in ((20.0, "-o"), (1e4, "--s")):
                own = [r for r in rows if (r["test"], r["mesh"], r["bulk_over_shear"]) == (test, name, ratio)]
                mine = [r for r in own if r["code"] == status.NAMES[status.CONVERGED]]
                axis.plot(
                    [r["run_s"] for r in mine],
                    [100 * abs(r["error"]) for r in mine],
                    style,
                    color=colour,
                    markersize=4,
                    label=f"{name}, K/mu {ratio:g}",
                )
        axis.set(xscale="log", yscale="log", xlabel="run time of a step [s]", title=test)
        plain_ticks(axis.yaxis)
    axes[0].set(ylabel="error of the reading [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=6, loc="outside right upper")
    return figure


if __name__ == "__main__":
    main([a for a in sys.argv[1:] if not a.startswith("-")])
