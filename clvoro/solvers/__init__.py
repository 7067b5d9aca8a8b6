"""Linear solvers and the systems they solve: the Poisson equation and the volume projection.

`poisson` assembles and solves the Poisson equation of the paper's (3.2), `volume_projection` the projection to given
cell volumes. `conjugate_gradient` and `multigrid` (with `aggregation` and `cycle`) are the solvers;
`linear_system` says what they are given and return.
"""
