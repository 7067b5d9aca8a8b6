"""The paper's validation case: its claims, one by one, against measurements.

Runs Lloyd only, Poisson only and both coupled from the same uniform random start, for several
starts, and prints for each claim of the paper what was measured and whether it holds:

    python bench/paper_case.py [--seeds 3] [--steps 100] [--k 1] [--device NAME] [--dtype float32] [--json]

Exits with 1 if a claim does not hold. `clvoro run paper` draws the pictures.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from _common import FIRST_SEED, make_adapter, parser

import clvoro
from clvoro.cli.cases import load_case
from clvoro.mesh.results import Result, summary

METHODS = ("lloyd", "poisson", "coupled")


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper.

    `measure` takes the results of the three methods from one start, and returns named numbers; `holds` takes these, and
    says whether the claim holds for that start. `criterion` has it in words.
    """

    text: str
    measure: Callable[[Mapping[str, Result]], dict[str, float]]
    holds: Callable[[dict[str, float]], bool]
    criterion: str


def mean_error(result: Result) -> float:
    return float(np.abs(result.size_error).mean())


def spread(result: Result) -> float:
    """Ratio of the 95th to the 5th percentile of the cells' sizes, 1 for a uniform mesh."""
    low, high = np.quantile(result.diagram.volumes ** (1 / result.points.shape[1]), [0.05, 0.95])
    return float(high / low)


def steps_until(result: Result, error: float) -> float:
    """First step whose mean error is at most `error`; infinite if there is none."""
    reached = np.flatnonzero(result.history["mean_error"] <= error)
    return float(reached[0]) if len(reached) else np.inf


def uniform(r: Mapping[str, Result]) -> dict[str, float]:
    return {
        "mean Q": float(r["lloyd"].quality.mean()),
        "size ratio p95/p5": spread(r["lloyd"]),
        "mean |e|": mean_error(r["lloyd"]),
    }


def poor(r: Mapping[str, Result]) -> dict[str, float]:
    return {
        "mean |e| at the start": float(r["poisson"].history["mean_error"][0]),
        "mean |e|": mean_error(r["poisson"]),
        "mean Q": float(r["poisson"].quality.mean()),
        "min Q": float(r["poisson"].quality.min()),
        "mean Q of lloyd": float(r["lloyd"].quality.mean()),
    }


def both(r: Mapping[str, Result]) -> dict[str, float]:
    return {
        "mean |e|": mean_error(r["coupled"]),
        "max |e|": float(np.abs(r["coupled"].size_error).max()),
        "mean Q": float(r["coupled"].quality.mean()),
        "min Q": float(r["coupled"].quality.min()),
        "mean |e| of poisson": mean_error(r["poisson"]),
        "mean Q of poisson": float(r["poisson"].quality.mean()),
    }


def drop(r: Mapping[str, Result]) -> dict[str, float]:
    """Share of the initial mean error that is left after a few steps."""

    def left(method: str, step: int) -> float:
        history = r[method].history["mean_error"]
        return float(history[min(step, len(history) - 1)] / history[0])

    return {
        "left after 1 step": left("coupled", 1),
        "after 5 steps": left("coupled", 5),
        "after 10 steps": left("coupled", 10),
        "of poisson": left("poisson", 10),
        "of lloyd": left("lloyd", 10),
    }


def faster(r: Mapping[str, Result]) -> dict[str, float]:
    level = 1.05 * mean_error(r["poisson"])
    return {
        "mean |e| to reach": level,
        "steps of coupled": steps_until(r["coupled"], level),
        "steps of poisson": steps_until(r["poisson"], level),
    }


def under(r: Mapping[str, Result]) -> dict[str, float]:
    return {
        "mean Q of lloyd": float(r["lloyd"].quality.mean()),
        "mean Q of coupled": float(r["coupled"].quality.mean()),
    }


def balance(r: Mapping[str, Result]) -> dict[str, float]:
    """How far Lloyd's and Poisson's displacements cancel: lengths over h, and their direction."""
    last, h = r["coupled"].final, r["coupled"].target_size[:, None]
    lloyd, poisson = last.lloyd / h, last.poisson / h
    return {
        "mean |Lloyd|/h": float(np.linalg.norm(lloyd, axis=1).mean()),
        "mean |Poisson|/h": float(np.linalg.norm(poisson, axis=1).mean()),
        "mean |sum|/h": float(np.linalg.norm(lloyd + poisson, axis=1).mean()),
        "correlation": float((lloyd * poisson).sum() / np.sqrt((lloyd**2).sum() * (poisson**2).sum())),
    }


def topology(r: Mapping[str, Result]) -> dict[str, float]:
    return {"share of cells": float(r["coupled"].history["ever_changed"][-1])}


CLAIMS = (
    Claim(
        "Lloyd only: excellent cell quality and nearly uniform cell sizes",
        uniform,
        lambda m: m["mean Q"] > 0.95 and m["size ratio p95/p5"] < 1.5 and m["mean |e|"] > 0.5,
        "mean Q > 0.95, sizes within 1.5, the metric missed by more than 50 %",
    ),
    Claim(
        "Poisson only: the target is reached, but with irregular, poorly shaped cells",
        poor,
        lambda m: m["mean |e|"] < 0.1 * m["mean |e| at the start"] and m["mean Q"] < m["mean Q of lloyd"] - 0.1,
        "less than a tenth of the initial error, mean Q more than 0.1 under Lloyd's",
    ),
    Claim(
        "Coupled: conforms to the target with much better cells",
        both,
        lambda m: m["mean |e|"] <= 1.1 * m["mean |e| of poisson"] and m["mean Q"] > m["mean Q of poisson"] + 0.1,
        "error at most 1.1 times Poisson's, mean Q more than 0.1 above its",
    ),
    Claim(
        "Immediate sharp decrease of the error, by the Poisson correction",
        drop,
        lambda m: m["after 10 steps"] < 2 / 3 and 1 - m["after 10 steps"] > 2 * (1 - m["of lloyd"]),
        "over a third of the error gone after 10 steps, and over twice what Lloyd alone takes off",
    ),
    Claim(
        "Coupled converges slightly faster than Poisson only",
        faster,
        lambda m: m["steps of coupled"] <= m["steps of poisson"],
        "no more steps to Poisson's final error (within 5 %)",
    ),
    Claim(
        "Coupled: quality slightly under that of Lloyd only",
        under,
        lambda m: -0.05 < m["mean Q of coupled"] - m["mean Q of lloyd"] < 0,
        "less than 0.05 under",
    ),
    Claim(
        "At the end Lloyd and Poisson displacements oppose and balance each other",
        balance,
        lambda m: m["correlation"] < -0.8 and m["mean |sum|/h"] < 0.5 * m["mean |Lloyd|/h"],
        "correlation under -0.8, their sum less than half of either",
    ),
    Claim(
        "Over 98 % of the cells change topology at some point",
        topology,
        lambda m: m["share of cells"] > 0.98,
        "share above 0.98",
    ),
)


def run_methods(adapter: clvoro.Adapter, seed: int, steps: int, k: float) -> dict[str, Result]:
    case = load_case("paper")
    return {
        method: adapter.run(
            case.domain,
            case.size_field(),
            method=method,
            points="uniform",
            max_steps=steps,
            options=clvoro.PaperOptions(tol=0, k=k),
            seed=seed,
        )
        for method in METHODS
    }


def judge(runs: list[dict[str, Result]]) -> list[dict]:
    """Measure every claim on every start."""
    verdicts = []
    for claim in CLAIMS:
        measured = [claim.measure(results) for results in runs]
        verdicts.append(
            {
                "claim": claim.text,
                "criterion": claim.criterion,
                "measured": measured,
                "holds": [claim.holds(m) for m in measured],
            }
        )
    return verdicts


def print_tables(runs: list[dict[str, Result]], verdicts: list[dict]) -> None:
    """Print ranges over the starts, and for each claim what was measured."""

    def span(values: list[float], form: str = ".3g") -> str:
        low, high = format(min(values), form), format(max(values), form)
        return low if low == high else f"{low} to {high}"

    print("| | mean \\|e\\| | max \\|e\\| | mean Q | min Q |\n|---|---|---|---|---|")
    for method in METHODS:
        s = [summary(results[method]) for results in runs]
        forms = (("mean_error", ".3f"), ("max_error", ".2f"), ("mean_quality", ".3f"))
        cells = [span([v[name] for v in s], form) for name, form in (*forms, ("min_quality", ".2f"))]
        print(f"| {method} | " + " | ".join(cells) + " |")
    print("\n| The paper's claim | measured | |\n|---|---|---|")
    for verdict in verdicts:
        names = verdict["measured"][0]
        parts = [f"{n} {span([m[n] for m in verdict['measured']])}" for n in names]
        good = sum(verdict["holds"])
        word = "holds" if good == len(runs) else f"holds for {good} of {len(runs)}"
        print(f"| {verdict['claim']} | {'; '.join(parts).replace('|', chr(92) + '|')} | {word} |")


def main() -> int:
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, default=3, metavar="N", help="random starts (3)")
    options.add_argument("--steps", type=int, default=100, help="steps per run (100)")
    options.add_argument("--k", type=float, default=1.0, help="the paper's k (1)")
    arguments = options.parse_args()

    adapter = make_adapter(arguments)
    runs = [run_methods(adapter, FIRST_SEED + 17 * n, arguments.steps, arguments.k) for n in range(arguments.seeds)]
    verdicts = judge(runs)
    if arguments.json:
        figures = [{m: summary(r) for m, r in results.items()} for results in runs]
        device = adapter.ctx.devices[0].name.strip()
        print(json.dumps({"device": device, "runs": figures, "claims": verdicts}))
    else:
        print(f"{adapter.ctx.devices[0].name.strip()}, k = {arguments.k:g}\n")
        print_tables(runs, verdicts)
    return 0 if all(all(v["holds"]) for v in verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
