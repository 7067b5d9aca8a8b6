"""Moving meshes: a lattice of generators that is mapped onto the size field, as in the paper's 2.3.4."""
