#include "opencl/real.h"

#define UNTOUCHED 0x7fffffff /* number of a cell that the boundary does not cross */
#define ISLAND -2            /* end of a chord that belongs to a hole inside its cell */

/* Segments of all crossed cells, cell by cell, piece by piece, loop by loop; see segment_t (trimmed.h). */
typedef struct {
    global const int *starts, *labels, *from, *to, *places;
    global const REAL2 *p, *q;
} segments_t;

#define SEGMENT_ARGS                                                                                                   \
    global const int *segment_starts, global const int *segment_labels, global const int *segment_from,                \
        global const int *segment_to, global const int *segment_places, global const REAL2 *segment_p,                 \
        global const REAL2 *segment_q
#define SEGMENTS                                                                                                       \
    {                                                                                                                  \
        segment_starts, segment_labels, segment_from, segment_to, segment_places, segment_p, segment_q                 \
    }

inline bool is_empty(const segments_t *s, int k)
{
    return s->labels[k] < 0 ? s->from[k] < 0 : s->from[k] == s->to[k];
}

/* The segment of cell j, crossed cell number u, that is the other side of segment k of cell i; -1 if there is none. */
inline int other_side(const segments_t *s, int k, int i, int u)
{
    for (int m = s->starts[u]; m < s->starts[u + 1]; ++m) {
        if (s->labels[m] != i || is_empty(s, m))
            continue;
        const bool ends_meet = s->from[k] < 0 ? s->to[m] < 0 : s->to[m] == s->from[k];
        const bool begins_meet = s->to[k] < 0 ? s->from[m] < 0 : s->from[m] == s->to[k];
        if (ends_meet && begins_meet)
            return m;
    }
    return -1;
}

/* The generator that gets the piece on the other side of segment k of cell i, -1 if unknown. */
inline int other_root(const segments_t *s, int k, int i, global const int *slots, global const int *roots)
{
    const int j = s->labels[k], u = slots[j];
    return u == UNTOUCHED ? j : roots[s->places[other_side(s, k, i, u)]];
}

/* Whether segment k of cell i, in a piece of generator `root`, is a face of the cell of `root`; *other: its neighbor.
 */
inline bool is_face(const segments_t *s, int k, int i, int root, global const int *slots, global const int *roots,
                    int *other)
{
    const int label = s->labels[k];
    if (is_empty(s, k)) {
        *other = -1;
        return false;
    }
    *other = label < 0 ? label : other_root(s, k, i, slots, roots);
    return *other != root;
}
