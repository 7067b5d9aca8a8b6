/* The boundary of a polygonal domain, cut by the cells into chords. Chords are numbered edge by edge and along each
   edge: in a ring of edges each chord begins at the end of the previous one.

   vertices[v]    corner of the polygon; edge v runs from it to vertices[next_vertex[v]], the domain on its left
   chord_firsts   (edges + 1) prefix sums: chords of each edge
   chord_cells    cell of the chord
   chord_edges    edge of the chord
   chord_ends     parameter of its end on the edge, 0 to 1; it begins at the end of the previous chord of the edge
   shells[v]      for edges of holes: an edge of the outer ring of their piece; -1 for edges of outer rings
   owner_sites[v] a point of the convex cell that corner v lies in: its generator, or, in a power diagram, where that
   may be elsewhere, its centroid */
#include "tessellation/corner.h"

/* Error bits of kernels; the .cl files define further ones. */
#define FLAG_LOST 1 /* a tracing found no exit */

typedef struct {
    global const REAL2 *vertices;
    global const int *next_vertex, *owners, *firsts, *cells, *edges;
    global const REAL *ends;
    global const int *shells;
    global const REAL2 *owner_sites;
} chords_t;

#define CHORD_ARGS                                                                                                     \
    global const REAL2 *vertices, global const int *next_vertex, global const int *vertex_owners,                      \
        global const int *chord_firsts, global const int *chord_cells, global const int *chord_edges,                  \
        global const REAL *chord_ends, global const int *shells, global const REAL2 *owner_sites
#define CHORDS                                                                                                         \
    {                                                                                                                  \
        vertices, next_vertex, vertex_owners, chord_firsts, chord_cells, chord_edges, chord_ends, shells, owner_sites  \
    }

/* Whether the chord begins, or ends, inside its cell, at a corner of the polygon; otherwise on a face of the cell. */
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

/* The end point of a chord, with the same bits for both cells. */
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

/* Points closer to a face than this are on it. */
#define ON_FACE (4 * REAL_EPS)

/* Signed distance, times |d|, of y beyond the face between generator i at x and generator j at x + d. */
inline REAL beyond_face(REAL2 y, REAL2 x, REAL2 d, int i, int j, global const REAL *points)
{
    const REAL s = dot(y - x - d / 2, d);
#ifdef WEIGHTED
    return s + (WEIGHT(points, j) - WEIGHT(points, i)) / 2;
#else
    return s;
#endif
}

inline bool is_on_face(REAL beyond, REAL d2)
{
    return beyond * beyond <= ON_FACE * ON_FACE * d2;
}

/* Whether a crossing at parameter t of an edge of squared length e2 coincides with the corner of the edge, if that lies
   on the face. */
inline bool is_at_corner(REAL t, REAL e2)
{
    return t * t * e2 <= 16 * ON_FACE * ON_FACE;
}
