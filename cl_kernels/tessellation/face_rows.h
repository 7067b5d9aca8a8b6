/* Rows of faces while a diagram is made: those that stay as they were lie in the previous graph, the others in slots of
   SLOT. A row that is longer takes several which follow each other, from spare ones: few cells are, and all would need
   as much room. */
#include "tessellation/short_faces.h"

#ifndef ROW_CAPACITY
#error "build with -DROW_CAPACITY=faces that a cell may have in the end"
#endif
#if !defined(SLOT) || SLOT > 32
#error "build with -DSLOT=faces that have room in a slot, whose bits in a word"
#endif

/* Bits of flags[0], in which kernels report what went wrong; flags[1] is not 0 where there are doubtful cells. The next
   spare slot is flags[3], flags[4] how many slots there are; flags[5]: faces that are nothing but rounding stay. */
#define FLAG_FULL 1     /* a cell has more faces than CELL_CAPACITY or ROW_CAPACITY, or than spare slots are left for */
#define FLAG_COINCIDE 2 /* two generators at the same place */
#define FLAG_COLLAPSED 4 /* generators too close for the precision */
#define FLAG_LOOPED 32   /* faces cross */

#define ELSEWHERE INT_MAX

/* places[i]  first slot of row i, or -1 if it is the previous graph's
   counts[s]  faces from slot s on, negative if rounding leaves a doubt; ELSEWHERE: they begin in the slot that this one
              names */
typedef struct {
    global const int *places, *slots, *counts, *old_starts, *old_neighbors;
} face_rows_t;

inline face_rows_t face_rows(global const int *places, global const int *slots, global const int *counts,
                             global const int *old_starts, global const int *old_neighbors)
{
    face_rows_t rows = {places, slots, counts, old_starts, old_neighbors};
    return rows;
}

/* Row i and the number of its faces. */
inline global const int *face_row(const face_rows_t *rows, int i, int *n)
{
    const int place = rows->places[i];
    if (place < 0) {
        const int start = rows->old_starts[i];
        *n = rows->old_starts[i + 1] - start;
        return rows->old_neighbors + start;
    }
    *n = abs(rows->counts[place]);
    return rows->slots + place * SLOT;
}

/* Is row i new, and has its cell left a doubt? */
inline bool is_doubtful_row(const face_rows_t *rows, int i)
{
    const int place = rows->places[i];
    return place >= 0 && rows->counts[place] < 0;
}

/* Write the faces of a clipped cell to its slot, or to spare ones, the least label first: a row depends on the cell
   alone, not on the order in which it was clipped. Its count is negative if rounding might let a neighbor see the
   faces otherwise. Returns the first slot. */
inline int store_cell(cell_t *cell, int flag, const REAL *x, global const REAL *points, int place, global int *slots,
                      global int *counts, global int *flags)
{
    bool doubtful = false;
    int to = place;
    if (flag == 0) {
        doubtful = is_doubtful(cell, x, points);
        if (doubtful && !flags[5])
            drop_short_faces(cell, points);
        if (cell->n > ROW_CAPACITY)
            flag = FLAG_FULL;
    }
    if (flag == 0 && cell->n > SLOT) {
        /* Which of them is chance; what they will hold is not. */
        const int taken = (cell->n + SLOT - 1) / SLOT;
        to = atomic_add(flags + 3, taken);
        if (to + taken > flags[4]) {
            flag = FLAG_FULL;
            to = place;
        }
    }
    if (flag) {
        atomic_or(flags, flag);
        cell->n = 0;
    }
    const int n = cell->n;
    int first = 0;
    for (int k = 1; k < n; ++k)
        first = cell->faces[k] < cell->faces[first] ? k : first;
    for (int k = 0; k < n; ++k)
        slots[to * SLOT + k] = cell->faces[first + k < n ? first + k : first + k - n];
    if (to != place) {
        slots[place * SLOT] = to;
        counts[place] = ELSEWHERE;
    }
    counts[to] = doubtful ? -n : n;
    if (doubtful)
        atomic_or(flags + 1, 1);
    return to;
}
