/* A piece is the intersection of a Voronoi cell with half-spaces { y : y.normal <= level }. The cell's generator may
   lie outside them. Coordinates are relative to that generator. A vector is a REAL4 with DIM components in use.

   piece_t                  a convex polygon or polyhedron
   build_piece              make the cell of generator i from its row of the neighbor graph
   note_piece, recall_piece copy a piece to and from the memory of a shape_t
   cut_piece                intersect with one half-space
   measure_piece            compute volume and centroid
   EACH_FACE(piece, f)      loop over the faces; face_label(piece, f) is the label of one */
#include "opencl/real.h"
#if DIM == 2
#include "tessellation/polygon.h"
#else
#include "tessellation/clip.h"
#endif

#define PIECE_WHOLE 0  /* the half-space contains the piece */
#define PIECE_CUT 1    /* a part was cut off */
#define PIECE_EMPTY 2  /* nothing is left */
#define PIECE_FULL 3   /* the piece has more faces than its arrays hold */
#define PIECE_BROKEN 4 /* round-off leaves no valid polyhedron */

#define NO_LABEL -1 /* the label of a face of the cell itself */

inline REAL4 load_vector(global const REAL *points, int i)
{
#if DIM == 2
    return (REAL4)(points[2 * i], points[2 * i + 1], 0, 0);
#else
    return (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
#endif
}

inline REAL dot_vectors(REAL4 a, REAL4 b)
{
#if DIM == 2
    return a.s0 * b.s0 + a.s1 * b.s1;
#else
    return a.s0 * b.s0 + a.s1 * b.s1 + a.s2 * b.s2;
#endif
}

#if DIM == 2

/* Face k runs counter-clockwise from corner k to corner k + 1. */
typedef struct {
    int n;
    REAL reach2; /* largest squared distance from the generator to a corner of the cell */
    REAL x[CELL_CAPACITY], y[CELL_CAPACITY];
    int labels[CELL_CAPACITY];
} piece_t;

#define EACH_FACE(piece, f)                                                                                            \
    int f = 0;                                                                                                         \
    f < (piece)->n;                                                                                                    \
    ++f

inline int face_label(private const piece_t *piece, int f)
{
    return piece->labels[f];
}

inline REAL4 corner_of(private const piece_t *piece, int k)
{
    return (REAL4)(piece->x[k], piece->y[k], 0, 0);
}

inline int corner_count(private const piece_t *piece)
{
    return piece->n;
}

inline int build_piece(private piece_t *piece, int i, global const int *starts, global const int *neighbors,
                       global const REAL *points, REAL4 box_lower, REAL4 box_upper)
{
    const REAL x[2] = {points[2 * i], points[2 * i + 1]};
    const REAL lower[2] = {box_lower.s0, box_lower.s1};
    const REAL upper[2] = {box_upper.s0, box_upper.s1};
    cell_t cell;
    start_polygon(&cell, i, x, lower, upper);
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const REAL d[2] = {points[2 * j] - x[0], points[2 * j + 1] - x[1]};
        const REAL d2 = d[0] * d[0] + d[1] * d[1];
        if (d2 == 0)
            return PIECE_BROKEN;
        if (!clip_polygon(&cell, d, d2, j, false, points))
            return PIECE_FULL;
    }
    piece->n = cell.n;
    piece->reach2 = cell.reach2;
    for (int k = 0; k < cell.n; ++k) {
        piece->x[k] = cell.x[k];
        piece->y[k] = cell.y[k];
        piece->labels[k] = NO_LABEL;
    }
    return PIECE_WHOLE;
}

typedef piece_t shape_t;

inline void note_piece(private shape_t *shape, private const piece_t *piece)
{
    *shape = *piece;
}

inline void recall_piece(private piece_t *piece, private const shape_t *shape)
{
    *piece = *shape;
}

/* Keep y.normal <= level. Vertices beyond the plane by no more than `depth` count as inside. The new face gets `label`.
 */
inline int cut_piece(private piece_t *piece, REAL4 normal, REAL level, REAL depth, int label)
{
    const int n = piece->n;
    REAL s[CELL_CAPACITY];
    int beyond = 0;
    for (int k = 0; k < n; ++k) {
        s[k] = piece->x[k] * normal.s0 + piece->y[k] * normal.s1 - level;
        beyond += s[k] > depth;
    }
    if (beyond == 0)
        return PIECE_WHOLE;
    if (beyond == n)
        return PIECE_EMPTY;
    REAL x[CELL_CAPACITY], y[CELL_CAPACITY];
    int labels[CELL_CAPACITY], count = 0;
    for (int k = 0; k < n; ++k) {
        const int next = k == n - 1 ? 0 : k + 1;
        const bool in = !(s[k] > depth), next_in = !(s[next] > depth);
        if (count > CELL_CAPACITY - 2)
            return PIECE_FULL;
        if (in) {
            x[count] = piece->x[k];
            y[count] = piece->y[k];
            labels[count++] = piece->labels[k];
        }
        if (in != next_in) {
            const REAL s_in = fmin(in ? s[k] : s[next], R(0)), s_out = in ? s[next] : s[k];
            const int a = in ? k : next, b = in ? next : k;
            const REAL t = s_in / (s_in - s_out);
            x[count] = piece->x[a] + t * (piece->x[b] - piece->x[a]);
            y[count] = piece->y[a] + t * (piece->y[b] - piece->y[a]);
            labels[count++] = in ? label : piece->labels[k];
        }
    }
    for (int k = 0; k < count; ++k) {
        piece->x[k] = x[k];
        piece->y[k] = y[k];
        piece->labels[k] = labels[k];
    }
    piece->n = count;
    return PIECE_CUT;
}

/* Sum over triangles that share corner 0, so that small pieces far from the generator keep their accuracy. */
inline REAL measure_piece(private const piece_t *piece, private REAL4 *centroid)
{
    const REAL4 o = corner_of(piece, 0);
    REAL sum = 0;
    REAL4 first = 0;
    for (int k = 2; k < piece->n; ++k) {
        const REAL4 a = corner_of(piece, k - 1) - o, b = corner_of(piece, k) - o;
        const REAL cross = difference_of_products(a.s0, b.s1, a.s1, b.s0);
        sum += cross;
        first += cross * (a + b);
    }
    *centroid = sum > 0 ? o + first / (3 * sum) : o;
    return sum > 0 ? sum / 2 : 0;
}

#else

typedef cell_t piece_t;

#define EACH_FACE(piece, f)                                                                                            \
    int f = next_face(piece, 0);                                                                                       \
    f < FACE_CAPACITY;                                                                                                 \
    f = next_face(piece, f + 1)

inline int face_label(private const piece_t *piece, int f)
{
    return piece->labels[f];
}

inline REAL4 corner_of(private const piece_t *piece, int k)
{
    return (REAL4)(((private const REAL *)piece->x)[k], ((private const REAL *)piece->y)[k],
                   ((private const REAL *)piece->z)[k], 0);
}

inline int corner_count(private const piece_t *piece)
{
    return piece->n;
}

inline int build_piece(private piece_t *piece, int i, global const int *starts, global const int *neighbors,
                       global const REAL *points, REAL4 box_lower, REAL4 box_upper)
{
    const REAL4 x = load_vector(points, i);
    start_polyhedron(piece, x, box_lower, box_upper);
    const int what = clip_polyhedron_by_row(piece, i, x, starts, neighbors, points);
    if (what >= CLIP_FULL)
        return what == CLIP_FULL ? PIECE_FULL : PIECE_BROKEN;
    return PIECE_WHOLE;
}

/* The vertices of a cell, without the room that a piece needs while it is cut. */
#define SHAPE_VERTICES (2 * FACE_CAPACITY - 4)
typedef struct {
    REAL x[SHAPE_VERTICES], y[SHAPE_VERTICES], z[SHAPE_VERTICES];
    INDEX4 faces[SHAPE_VERTICES], links[SHAPE_VERTICES];
    uint alive[FACE_WORDS];
    int n;
} shape_t;

inline void note_piece(private shape_t *shape, private const piece_t *piece)
{
  private
    const REAL *x = X(piece), *y = Y(piece), *z = Z(piece);
    for (int v = 0; v < piece->n; ++v) {
        shape->x[v] = x[v];
        shape->y[v] = y[v];
        shape->z[v] = z[v];
        shape->faces[v] = piece->faces[v];
        shape->links[v] = piece->links[v];
    }
    for (int w = 0; w < FACE_WORDS; ++w)
        shape->alive[w] = piece->alive[w];
    shape->n = piece->n;
}

/* All faces are those of the cell itself. */
inline void recall_piece(private piece_t *piece, private const shape_t *shape)
{
  private
    REAL *x = X(piece), *y = Y(piece), *z = Z(piece);
    for (int v = 0; v < shape->n; ++v) {
        x[v] = shape->x[v];
        y[v] = shape->y[v];
        z[v] = shape->z[v];
        piece->faces[v] = shape->faces[v];
        piece->links[v] = shape->links[v];
    }
    for (int w = 0; w < FACE_WORDS; ++w)
        piece->alive[w] = shape->alive[w];
    piece->n = shape->n;
    for (int f = 0; f < FACE_CAPACITY; ++f)
        piece->labels[f] = NO_LABEL;
}

/* Keep y.normal <= level. Vertices beyond the plane by no more than `depth` count as inside. The new face gets `label`.
   Unlike `clip_polyhedron` this takes any plane. New vertices are interpolated along edges, which is accurate since no
   edge is longer than the cell. */
inline int cut_piece(private piece_t *piece, REAL4 normal, REAL level, REAL depth, int label)
{
  private
    const REAL *x = X(piece), *y = Y(piece), *z = Z(piece);
  private
    REAL *s = (private REAL *)piece->beyond;
    int beyond = 0;
    for (int v = 0; v < piece->n; ++v) {
        s[v] = x[v] * normal.s0 + y[v] * normal.s1 + z[v] * normal.s2 - level;
        beyond += s[v] > depth;
    }
    if (beyond == 0)
        return PIECE_WHOLE;
    if (beyond == piece->n)
        return PIECE_EMPTY;
    if (!find_rim(piece, depth)) {
        if (!keep_disc(piece, depth, 64 * depth) || !find_rim(piece, depth))
            return PIECE_BROKEN;
        if (piece->rim.gone == piece->n)
            return PIECE_EMPTY;
    }
    const int face = replace_faces(piece, label);
    if (face == FACE_CAPACITY)
        return PIECE_FULL;
    cut_edges(piece);
    close_rim(piece, face);
    return PIECE_CUT;
}

/* Sum over tetrahedra that share vertex 0, so that small pieces far from the generator keep their accuracy. */
inline REAL measure_piece(private piece_t *piece, private REAL4 *centroid)
{
    const REAL4 o = corner_of(piece, 0);
  private
    const INDEX *start = face_starts(piece);
    REAL sum = 0;
    REAL4 first = 0;
    for (EACH_FACE (piece, f)) {
        const REAL4 a = corner_of(piece, start[f]) - o;
        int v = vertex_after(piece, start[f], f);
        REAL4 b = corner_of(piece, v) - o;
        for (v = vertex_after(piece, v, f); v != start[f]; v = vertex_after(piece, v, f)) {
            const REAL4 c = corner_of(piece, v) - o;
            const REAL triple = dot_vectors(a, cross_product(b, c));
            sum += triple;
            first += triple * (a + b + c);
            b = c;
        }
    }
    *centroid = sum > 0 ? o + first / (4 * sum) : o;
    return sum > 0 ? sum / 6 : 0;
}

#endif
