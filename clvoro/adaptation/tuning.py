"""Tuned numbers of this package; their evidence is in `bench/RESULTS.md`. Those of efforts are in `plan/efforts.py`.

Lengths are over h, the target size, unless they say otherwise. e is the error of a size, Q the quality of a cell.
"""


# The start of a run.

NEAR_ERROR, NEAR_COUNT = 0.15, 0.02
"""Mean |e|, and share of missing cells, up to which a given mesh is only corrected."""
FAR, STRETCH = 1.6, 16.0
"""Ratio of given to expected spacing, or its inverse, from which given points are replaced; number of points, given and
expected, of the pieces of the domain in which this ratio is taken."""
DEFICIT_3D = 0.36
"""1 - mean Q in 3D up to which a given mesh counts as smoothed."""
WALL_DEFICIT = 0.49
"""1 - mean Q that walls and unrelieved strain cost in 2D, times the square root of the number of cells."""
STEEP, STEEPEST, LEAST_STEEP = 0.1, 0.18, 0.01
"""Slopes |grad h| between which the error target grows, and the share of steep cells from which it does."""
SINGLE_LEVEL_ERROR_TARGET = 0.0017
"""Largest error target with one level."""
SAMPLED_SIZES = 2000
"""Places at which sizes are compared with the largest one of the domain."""
STEPS = 100
"""Default number of steps of a method that repeats one kind of step."""
WINDOW = 10
"""Steps over which error and quality are averaged to detect stagnation."""
REACHED = 0.8
"""Share of an error target, larger than the effort's own, below which `trade` says where the error ends."""
RENEWAL = 10
"""Steps after which a run with checkpoints computes its mesh anew, and may write one."""

# Levels.

COARSEST = {2: 1400, 3: 1500}
"""Approximate number of cells of the coarsest level by dimension."""
LATTICE = {2: float("inf"), 3: 1000}
"""Least number of cells of equal sizes that start from a lattice, by dimension. In 2D lattices form in any run."""
LATTICE_GLIDE = 0.5
"""Number of gliding steps of a run that starts from a lattice, over that of a run from random points on one level."""
LATTICE_CELLS, MOST_GLIDE = 4000.0, 5.0
"""A run of n cells takes 1 + (`LATTICE_CELLS` / n)^2 times as many of them, but at most `MOST_GLIDE` times: most of few
cells are near walls, where the lattice ends."""
PART_CELLS = {2: 100_000, 3: 50_000}
"""Least number of cells of a part on coarser levels, by dimension: on levels of fewer cells not all parts work."""
CELLS_ACROSS = 5.0
"""Least number of cells between layers on coarser levels. Layers are as fine there as on the finest level."""
STEP_CELLS = 3000
"""Cost of the launches of a step, as a number of cells."""
SHORT_FACE = 0.02
"""Share of a cell's length (squared in 3D) below which a face brings no new generator in a refinement."""
COINCIDENT = 256
"""Distance in ulps below which new generators in polygons count as coincident."""
CHECKED, CHECKED_PER_EDGE = 5000, 4
"""Number of generators, in all or per edge of the boundary, up to which the host looks for coincident ones."""

# Numbers of cells.

COUNT_SHARE = 0.03
"""Share of the cells by which their number may differ before dislocations climb."""
COUNT_LEAST = 1e-3
"""The same while polishing, because few steps are left for a new cell to improve."""
COUNT_EXACTLY = 1e-6
"""The same after cells have been repaired, if sizes are to be exact."""
COUNT_CLIMB_STRAIN = 0.3
"""Strain above which dislocations climb while polishing: only the number of cells makes them climb."""
COUNT_FINEST_3D = {False: 3e-3, True: 1e-4}
"""Share of the cells by which their number may differ on the finest of several levels in 3D, without and with exact
sizes. Lengths then differ by a third of it."""
POLISH_COUNT_3D, POLISH_GROWTH_3D = 5e-3, 1.016
"""The same while polishing in 3D, and the factor by which polishing raises the number after refinement."""
SAMPLING_GAIN = 0.26
"""Factor on the error of the number of cells, by sizes at the generators, from one level to the next finer one."""
LEAST_PROGRESS, MAX_OSCILLATIONS = 0.9, 2
"""Corrections of the number of cells end after `MAX_OSCILLATIONS` changes from too many cells to too few or back, which
start again from zero when the error falls below `LEAST_PROGRESS` times the smallest one before."""
CLIMB_STRAIN = 0.06
"""Strain across a dislocation (a 5-sided and a 7-sided cell) above which it climbs."""
WALL_STRAIN = 0.3
"""Strain that keeps a dislocation from ending at the wall beside it."""
NUCLEATION_STRAIN = 0.22
"""Anisotropy of the lattice above which a pair of dislocations may be nucleated."""
PAIR_RINGS, NUCLEUS_RINGS, LOG_RATIO_RINGS = 4, 6, 3
"""Rings of cells between sites that change in the same call, so that their displacements do not interact."""
FAR_COUNT, FAR_RINGS = 0.1, {2: 3, 3: 1}
"""If more than this share of the generators is missing or superfluous, so many rings are between sites, by dimension.
In 3D three rings are some 200 cells, and in some regions nearly all cells change."""
ROUNDS = 3
"""Rounds of choosing sites. Each takes the strongest of the remaining sites."""
SHIFTS, SHIFT_STEP = 51, 0.01
"""Shifts of the threshold that are tried to bring the number of generators closest to the required one."""
SPLIT_DISTANCE = 0.3
"""Half the initial distance of the two halves of a split cell."""
MAX_CHANGE, REPAIRED_SHARE = 0.05, 1e-3
"""Shares of the generators that one call may insert or delete to correct their number, and of cells that it repairs."""
LEAST_GAIN = 2.0
"""Half the sum of |u|^2 / h^2 over the cells that an insertion or deletion must save, to balance parts of a domain."""
SITE_RINGS, BLOCKED_RINGS = 12, 3
"""Least number of rings of cells between two sites of the same round of a balance, and of different rounds."""
LEAST_CHANGES = 1e-4
"""Share of the cells that a round of a balance has to insert or delete, if there is to be another one."""
LEAST_OFFSET, PIECE, LARGEST_OFFSET = 0.25, 900.0, 3.0
"""The offset of the potential for each cell that a piece of the domain lacks is `PIECE` over the number of its cells,
at least `LEAST_OFFSET` and at most `LEAST_GAIN`. The whole offset is at most `LARGEST_OFFSET`. In domains of one piece
it is `LEAST_OFFSET` per cell. It favors insertions."""
BALANCE_TOLERANCE = 3e-2
"""Relative residual of the potential of a balance."""
BALANCED_ALONE = 150_000
"""Cells of all parts up to which part 0 balances them alone: its rounds have few cells for each of many messages."""
MAX_BALANCES = 6
"""Largest number of calls, one after the other, that insert and delete in regions that fixed generators cut off."""

# Steps and their solves.

START_TOLERANCE = 3e-2
"""Relative residual of Poisson solves in 2D on the coarsest of several levels."""
GLIDE_TOLERANCE, POLISH_TOLERANCE = 0.3, 1e-2
"""Relative residuals of projections while gliding and polishing. Each projection starts from the last solution."""
COARSE_PENALTY, COARSE_TOLERANCE = 0.3, 0.1
"""Penalty and relative residual of projections on coarser levels in 3D."""
SINGLE_LEVEL_QUALITY_SCALE = 0.15
"""Smallest quality scale of polishing with one level."""
POLISH_MOMENTUM_3D, POLISH_RATE_3D = 0.5, 0.055
"""Share of the last displacement, and step length, of polishing in 3D, where the weight of cells is about 7.5."""
LOOSE_POLISH_3D, SETTLE_PENALTY_3D, SCALE_PER_ERROR_3D = 2.0, 0.7, 12.0
"""Error target of polishing in 3D over that of the run; penalty of the one projection that then meets the latter; scale
of log(L / h) over its mean magnitude, where that is large."""
PENALTY_PER_ERROR = 750.0
"""Largest penalty over the error target, for targets above 0.004. The smallest penalty is 1e-3, or a smaller target."""
AT_WALLS, AT_WALLS_OF_BOXES = 2.0, 10.0
"""The quality scale of cells on walls over that of the others, in polygons and elsewhere."""
MOST_AT_WALLS = 0.4
"""In polygons, the largest penalty of cells on walls, which would give up their sizes for little quality."""
CALM_MOMENTUM, CALM_BAD_CELL_WEIGHT = 0.7, 20.0
"""Largest parameters at thin walls, where larger steps part the pairs of generators."""
FULL_RATE = 5.0
"""Largest omega h^2 / A of a cell and its neighbors up to which a generator moves at the full rate of the descent of
quality; beyond it the rate is smaller in proportion. h^2 / A is 1.15 where a cell has its size."""
LONGEST_DESCENT = 0.2
"""Largest displacement by the descent of quality."""
OPENINGS, MOST_OBTUSE = 12, 0.02
"""Most times that obtuse triangles are opened, and their number per cell beyond which they are left."""
STRIDE = 2.0
"""Largest displacement of a stride."""
NEAR_PENALTY = 0.03
"""Initial penalty of polishing a corrected mesh: a larger one would give up the sizes first."""
TIGHT = 0.43
"""Share of the effort's error target below which polishing begins with a penalty that is smaller in proportion, the
number of cells is exact, and grad log h comes from the field."""
SEPARATE_PENALTY = 20.0
"""Penalty of the last steps, which only push short edges apart, so that sizes change little."""
SETTLING_STEPS = 4
"""Steps of polishing and separation after the last cells of four sides have been deleted."""
OPENING_PROJECTIONS = 4
"""Number of the last exact projections after each of which obtuse triangles are opened."""

# Exact sizes.

GRADIENT_STEP = 0.2
"""Step of the differences for the gradient of the size field in exact projections."""
EXACT_PENALTY, EXACT_TOLERANCE, EXACT_ITERATIONS = 1e-2, 0.1, 30
"""Penalty of the first exact projections in boxes in 2D, and limits of all. Each projection starts from the solution of
the last, and what a solve leaves is no more than the error of the linearization."""
EXACT_PENALTY_PER_ERROR, MET_ERROR = 4.0, 1e-3
"""In polygons and solids the penalty of exact projections is at least the first number times what the mean |log(L / h)|
exceeds the second by. Cells have to pass through narrow parts of a polygon, and a solid may have no mesh of the sizes:
with a smaller penalty cells lose their shape."""
NEWTON_PENALTY, NEWTON_ITERATIONS_3D, NEWTON_TOLERANCES_3D = 1e-3, 45, (0.1, 0.03, 0.03)
"""Penalty of Newton's steps, the last exact projections, and their limits in 3D."""
PROJECT_STEPS, NEWTON_STEPS = 3, 3
"""Number of exact projections before Newton's steps in boxes in 2D, and of those. The first of those also separates
vertices."""
EXACT_STEPS, EXACT_STEPS_3D = PROJECT_STEPS + 1 + NEWTON_STEPS, len(NEWTON_TOLERANCES_3D)
"""Number of steps of the last phase of method "exact" in boxes, the Poisson correction among them."""
GRADUAL_PENALTIES = ((0.1, 0.03), (0.03, 0.03), (0.01, 0.03), *[(1e-3, 0.0)] * 6)
"""In polygons: penalty, and scale of the quality in it (see `Penalty`), of each step before Newton's."""
GRADUAL_TOLERANCE, GRADUAL_ITERATIONS, GRADUAL_NEWTON_STEPS = 1e-3, 45, 2
"""Limits of the exact projections in polygons, and the number of Newton's steps, which all separate vertices."""
NEWTON_QUALITY_SCALE = 0.1
"""In polygons: scale of the quality in the penalty of Newton's steps. Bad cells may miss their size a little."""
MOVES = 1
"""Moves to the centroids of power cells."""

# Corners and thin walls.

DEPTHS, MOST_SAMPLES = (0.1, 0.2, 0.3), 64
"""Depths behind a wall: if one is in the domain again, the wall is thin. Most places on an edge where this is asked."""

NEAR_SIZE = 1.25
"""Ratio of the cells' own size and the size field from which on corners work with the former."""

# Fixed generators.

CLOSE, AT_WALL, ON_WALL = 0.4, 0.2, 0.01
"""Distances below which a run warns of two fixed generators or of one near a wall, and refuses one on a wall."""
CANDIDATES, BEHIND_WALL = 8, 4.0
"""Others near a fixed generator that are compared, and the factor on the distance of those behind a wall."""

# Generators beside lines.

SQUEEZED = 0.6
"""Sizes over h below which cells beside lines are deleted."""
BALL_PASSES, CLEARINGS = 3, 10
"""How often a step moves a generator out of the balls around lines, which overlap; the same at the start of the finest
level, where generators that are still in a ball are left out."""
