"""The mesh as a finite-volume solver reads it: flat faces, and the measures and limits of solvers."""
