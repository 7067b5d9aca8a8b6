"""Time of runs with an error target against JIGSAW's, by a yardstick.

    python bench/front_time.py [--repeat 5] [--device NAME] [--dtype float32] [--json]

JIGSAW 1.0 is not measured here: no package of it installs with pip. Its seconds on two circles (7,270 cells, default
settings, and 64 optimization passes) are given, from one machine where the default of clvoro took 0.8 s for the same
field. So this script measures what runs take in units of the default, by turns, in processor time, and multiplies.

Those 0.8 s are of an earlier state of the default, whose mesh was worse (mean |e| 0.0026, mean Q 0.9777, least Q
0.834). Nothing shows that the default of today takes equally long on that machine. So "over JIGSAW" is a rough figure.
"""

from __future__ import annotations

import statistics
import time

from _common import BOX, FIRST_SEED, Report, figures, heading, make_adapter, parser, shown, test_field

import clvoro

YARDSTICK = 0.8
RUNS = (
    ("default", None, None),
    ("default", 0.0155, ("default", 0.9)),
    ("default", 0.025, ("default", 0.9)),
    ("best", 0.025, ("64 passes", 1.7)),
)
"""Effort, error target, and settings and seconds of JIGSAW."""
COLUMNS = {
    "run": lambda r: r["run"],
    "mean |e|": shown("mean_error", ".4f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "CPU s": shown("seconds", ".2f"),
    "over the default": shown("ratio", ".2f"),
    "JIGSAW": lambda r: r["against"],
    "over JIGSAW": shown("over", ".2f"),
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--repeat", type=int, default=5, metavar="N", help="medians over N (5)")
    options = options_of.parse_args()
    adapter, field = make_adapter(options), test_field("circles")
    times: list[list[float]] = [[] for _ in RUNS]
    meshes: list[clvoro.Result] = []
    for turn in range(options.repeat + 1):
        for k, (effort, target, _) in enumerate(RUNS):
            aimed = clvoro.MultilevelOptions(error_target=target)
            begun = time.process_time()
            mesh = adapter.run(BOX, field, seed=FIRST_SEED, effort=effort, options=aimed)
            if turn:  # the first one builds kernels
                times[k].append(time.process_time() - begun)
            else:
                meshes.append(mesh)
    report = Report(options.json, COLUMNS)
    for (effort, target, peer), mesh, taken in zip(RUNS, meshes, times, strict=True):
        ratio = statistics.median(t / unit for t, unit in zip(taken, times[0], strict=True))
        report.add(
            {
                "run": effort if target is None else f"{effort}, target {target:g}",
                **figures(mesh.diagram, mesh.target_size, mesh.quality),
                "seconds": statistics.median(taken),
                "ratio": ratio,
                "against": "" if peer is None else f"{peer[0]}, {peer[1]:g} s",
                "over": None if peer is None else ratio * YARDSTICK / peer[1],
            }
        )
    report.finish(heading(adapter, "Two circles: time in units of the default"))


if __name__ == "__main__":
    main()
