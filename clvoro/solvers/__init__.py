"""Linear solvers, and the systems they solve: the Poisson equation and the volume projection."""
