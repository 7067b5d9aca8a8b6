"""Conservative transfer of cell data between meshes."""
