/* Cells lie in private memory; or, if a team builds them, in local memory; or, with -DCELL_BYTES=bytes of one cell, in
   `cell_places` places in global memory, where work-item k does each `cell_places`-th cell from the k-th on: drivers
   of GPUs reserve private memory for all work-items that fit on the device at once. */
#ifdef TEAM
#define CELL_SPACE local
#elif defined(CELL_BYTES)
#define CELL_SPACE global
#define CELL_ARGS , global uchar *cell_memory, const int cell_places
#define CELLS , cell_memory, cell_places
#define EACH_CELL(i, k) for (int i = k; i < size; i += cell_places)
#define TAKE_CELL(cell, k) global cell_t *cell = (global cell_t *)(cell_memory + (size_t)CELL_BYTES * k)
#else
#define CELL_SPACE private
#define CELL_ARGS
#define CELLS
#define EACH_CELL(i, k) for (int i = k; i < size; i = size)
#define TAKE_CELL(cell, k)                                                                                             \
    cell_t own_cell;                                                                                                   \
  private                                                                                                              \
    cell_t *cell = &own_cell
#endif
