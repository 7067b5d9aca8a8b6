/* The boundary of a polygonal domain as cells see it: cut by them into chords, which are numbered edge by edge and
   along each edge, so that in a ring of edges one chord begins where the one before ends.

   vertices[v]    corner of the polygon; edge v runs from it to vertices[next_vertex[v]], the domain on its left
   chord_firsts   (edges + 1) prefix sums: chords of each edge
   chord_cells    whose cell the chord lies in
   chord_edges
   chord_ends     where along its edge it ends, 0 to 1; it begins where the one before on the edge ends
   shells[v]      of edges of holes: an edge of the outer ring of their piece; -1 for edges of outer rings */
#include "tessellation/corner.h"

/* Bits of the word in which kernels report what went wrong: this one; others' own follow in their files. */
#define FLAG_LOST 1 /* a walk found no way on */

typedef struct {
    global const REAL2 *vertices;
    global const int *next_vertex, *owners, *firsts, *cells, *edges;
    global const REAL *ends;
    global const int *shells;
} chords_t;

#define CHORD_ARGS                                                                                                     \
    global const REAL2 *vertices, global const int *next_vertex, global const int *vertex_owners,                      \
        global const int *chord_firsts, global const int *chord_cells, global const int *chord_edges,                  \
        global const REAL *chord_ends, global const int *shells
#define CHORDS                                                                                                         \
    {                                                                                                                  \
        vertices, next_vertex, vertex_owners, chord_firsts, chord_cells, chord_edges, chord_ends, shells               \
    }

/* Does the chord begin, or end, inside its cell, at a corner of the polygon? Else on a face of the cell. */
inline bool begins_inside(const chords_t *c, int chord)
{
    return chord == c->firsts[c->edges[chord]];
}

inline bool ends_inside(const chords_t *c, int chord)
{
    return chord + 1 == c->firsts[c->edges[chord] + 1];
}

inline int chord_after(const chords_t *c, int chord)
{
    return ends_inside(c, chord) ? c->firsts[c->next_vertex[c->edges[chord]]] : chord + 1;
}

/* The point at which a chord ends: the same number for the two cells that meet there. */
inline REAL2 chord_end(const chords_t *c, int chord)
{
    const int edge = c->edges[chord];
    const REAL2 a = c->vertices[edge], b = c->vertices[c->next_vertex[edge]];
    const REAL t = c->ends[chord];
    return t <= 0 ? a : (t >= 1 ? b : a + t * (b - a));
}

inline REAL2 chord_begin(const chords_t *c, int chord)
{
    return begins_inside(c, chord) ? c->vertices[c->edges[chord]] : chord_end(c, chord - 1);
}

/* What lies so near to a face is on it. */
#define ON_FACE (4 * REAL_EPS)

inline bool is_on_face(REAL beyond, REAL d2)
{
    return beyond * beyond <= ON_FACE * ON_FACE * d2;
}

/* A crossing of an edge, of squared length e2, with a face so near to the corner, t of the edge away, is at it, if that
   is on the face. */
inline bool is_at_corner(REAL t, REAL e2)
{
    return t * t * e2 <= 16 * ON_FACE * ON_FACE;
}
