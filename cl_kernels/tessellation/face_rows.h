/* Rows of faces while a diagram is made. Unchanged rows stay in the previous graph, new ones lie in slots of SLOT
   entries. A longer row takes several consecutive spare slots. */
#include "tessellation/report.h"
#include "tessellation/short_faces.h"

#ifndef ROW_CAPACITY
#error "build with -DROW_CAPACITY=faces that a cell may have in the end"
#endif
#if !defined(SLOT) || SLOT > 32
#error "build with -DSLOT=faces that have room in a slot, whose bits in a word"
#endif

/* Whether matched rows are those of a diagram with room for `room` half-faces, without a doubt. */
inline bool are_right(global const int *report, int room)
{
    return report[REPORT_FLAGS] == 0 && report[REPORT_SPARE] <= report[REPORT_SLOTS] && report[REPORT_MARKED] == 0 &&
           report[REPORT_KEPT] <= room;
}

#define ELSEWHERE INT_MAX

/* places[i]  first slot of row i, or -1 if it lies in the previous graph; places may be 0 if all lie there
   counts[s]  faces from slot s on, negative if round-off leaves a doubt; ELSEWHERE: the row begins in the slot given
              there */
typedef struct {
    global const int *places, *slots, *counts, *old_starts, *old_neighbors;
} face_rows_t;

inline face_rows_t face_rows(global const int *places, global const int *slots, global const int *counts,
                             global const int *old_starts, global const int *old_neighbors)
{
    face_rows_t rows = {places, slots, counts, old_starts, old_neighbors};
    return rows;
}

inline int place_of_row(const face_rows_t *rows, int i)
{
    return rows->places ? rows->places[i] : -1;
}

/* Row i and the number of its faces. */
inline global const int *face_row(const face_rows_t *rows, int i, int *n)
{
    const int place = place_of_row(rows, i);
    if (place < 0) {
        const int start = rows->old_starts[i];
        *n = rows->old_starts[i + 1] - start;
        return rows->old_neighbors + start;
    }
    *n = abs(rows->counts[place]);
    return rows->slots + place * SLOT;
}

/* Whether row i is new and its cell doubtful. */
inline bool is_doubtful_row(const face_rows_t *rows, int i)
{
    const int place = rows->places[i];
    return place >= 0 && rows->counts[place] < 0;
}

/* Write the faces of a clipped cell to its slot, or to spare slots, starting with the least label: the row does not
   depend on the order of clipping. The count is negative if round-off might give a neighbor other faces. Returns the
   first slot. */
inline int store_cell(cell_t *cell, int flag, const REAL *x, global const REAL *points, int place, global int *slots,
                      global int *counts, global int *report)
{
    bool doubtful = false;
    int to = place;
#ifdef SPHERE
    for (int k = 0; k < cell->n; ++k)
        if (cell->faces[k] < 0)
            flag |= FLAG_OPEN;
#endif
    if (flag == 0) {
        doubtful = is_doubtful(cell, x, points);
        if (doubtful && !report[REPORT_WHOLE])
            drop_short_faces(cell, points);
#ifdef WEIGHTED
        if (cell->n < 3)
            cell->n = 0; /* no larger than round-off */
#endif
        if (cell->n > ROW_CAPACITY)
            flag = FLAG_FULL;
    }
    if (flag == 0 && cell->n > SLOT) {
        /* The slot depends on the order of work-items, its content does not. */
        const int taken = (cell->n + SLOT - 1) / SLOT;
        to = atomic_add(report + REPORT_SPARE, taken);
        if (to + taken > report[REPORT_SLOTS]) {
            flag = FLAG_FULL;
            to = place;
        }
    }
    if (flag) {
        atomic_or(report, flag);
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
        atomic_or(report, FLAG_DOUBT);
    return to;
}
