"""Model of the time of a step over many ranks: the cells, the values of ghosts, and the waiting for messages.

    python bench/rank_model.py [--cells 1e10] [--ranks 8,64,512,1000] [--dim 3] [--rate 5e6] [--exchanges 25]
                               [--reductions 20] [--ghosts 2] [--words 1.5] [--bandwidth 2e10] [--latency 5e-6]
                               [--copy 2e-5] [--json]

Nothing is measured here. Assumptions, each of them an option:

- a device makes `--rate` cells per second in a step, in 2D also those of ghosts;
- in a step a rank exchanges the values of ghosts `--exchanges` times, and takes `--reductions` sums over all ranks, as
  `bench/parallel.py` counts them; an exchange sends `--words` numbers of 8 bytes for each ghost in the mean;
- a rank has `--ghosts` times 2 d (n / p)^((d - 1) / d) ghosts, the column `ghosts` of that script, and sends a message
  to each of 26 neighbors (8 in 2D) in an exchange;
- the network has `--bandwidth` bytes per second and rank, and `--latency` seconds per message; a sum over p ranks waits
  for 2 log2(p) of them; each exchange and each sum also waits for two copies of `--copy` seconds between device and
  host;
- the largest rank has 1.1 times the mean number of cells: above that, generators are divided anew.

The search for ghosts on the hosts is not counted; `bench/parallel.py` has it in `CPU s`.

`efficiency` is the time that one device takes for the mean number of cells, divided by the time of the step. Limits
of clvoro are not counted: labels have 32 bits, so that all ranks have at most 2e9 cells, and a rank holds at most 1e8.
"""

from __future__ import annotations

import math

from _common import Report, counts, parser, shown

COLUMNS = {
    "ranks": shown("ranks", ",d"),
    "cells each": shown("own", ",.0f"),
    "cells s": shown("compute", ".3f"),
    "bytes s": shown("bytes", ".4f"),
    "messages s": shown("messages", ".4f"),
    "sums s": shown("sums", ".4f"),
    "copies s": shown("copies", ".4f"),
    "step s": shown("step", ".3f"),
    "efficiency": shown("efficiency", ".2f"),
}
NEIGHBORS, LARGEST = {2: 8, 3: 26}, 1.1


def main() -> None:
    """Print a table of the parts of a step for each number of ranks."""
    p = parser(__doc__)
    p.add_argument("--cells", type=float, default=1e10, help="number of cells")
    p.add_argument("--ranks", type=counts, default=[8, 64, 512, 1000], help="numbers of ranks")
    p.add_argument("--dim", type=int, choices=(2, 3), default=3, help="dimension")
    p.add_argument("--rate", type=float, default=5e6, help="cells per second of a device")
    p.add_argument("--exchanges", type=float, default=25, help="exchanges of ghosts in a step")
    p.add_argument("--reductions", type=float, default=20, help="sums over all ranks in a step")
    p.add_argument("--ghosts", type=float, default=2, help="ghosts over one layer around a part")
    p.add_argument("--words", type=float, default=1.5, help="numbers per ghost in an exchange")
    p.add_argument("--bandwidth", type=float, default=2e10, help="bytes per second and rank")
    p.add_argument("--latency", type=float, default=5e-6, help="seconds per message")
    p.add_argument("--copy", type=float, default=2e-5, help="seconds per copy between device and host")
    o = p.parse_args()
    table = Report(o.json, COLUMNS)
    for ranks in o.ranks:
        own = o.cells / ranks
        ghosts = o.ghosts * 2 * o.dim * own ** ((o.dim - 1) / o.dim) if ranks > 1 else 0.0
        record = {
            "ranks": ranks,
            "own": own,
            "compute": (LARGEST * own + (ghosts if o.dim == 2 else 0.0)) / o.rate,
            "bytes": o.exchanges * o.words * 8 * ghosts / o.bandwidth,
            "messages": o.exchanges * min(NEIGHBORS[o.dim], ranks - 1) * o.latency,
            "sums": o.reductions * 2 * math.log2(ranks) * o.latency,
            "copies": (o.exchanges + o.reductions) * 2 * o.copy * (ranks > 1),
        }
        step = sum(record[part] for part in ("compute", "bytes", "messages", "sums", "copies"))
        table.add(record | {"step": step, "efficiency": own / o.rate / step})
    table.finish(f"Model of a step of {o.cells:.3g} cells in {o.dim}D")


if __name__ == "__main__":
    main()
