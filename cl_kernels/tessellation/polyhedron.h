/* A convex polyhedron around its generator. Coordinates are relative to the generator: differences of close positions
   are exact, so cells of any size are accurate.

   The polyhedron is simple: three faces meet in every vertex (where more do, vertices coincide). Its dual is a
   triangulated sphere: a vertex is the triangle of its three faces, counter-clockwise seen from outside. */
#include "opencl/real.h"

#ifndef FACE_CAPACITY
#error "build with -DFACE_CAPACITY=faces that a cell may have while it is clipped, a multiple of 64"
#endif
/* Usually short loops: vectorization would not pay. */
#ifdef __clang__
#define SHORT_LOOP _Pragma("clang loop vectorize(disable) interleave(disable) unroll(disable)")
#else
#define SHORT_LOOP
#endif

#define REAL8 CLVORO_JOIN(REAL, 8)
#define VERTEX_CAPACITY (2 * FACE_CAPACITY) /* 2 F - 4, rounded up to whole vectors */
#if VERTEX_CAPACITY <= 256
#define INDEX uchar
#define INDEX4 uchar4
#else
#define INDEX ushort
#define INDEX4 ushort4
#endif

/* Sets of faces. */
#define FACE_WORDS (FACE_CAPACITY / 64)
#define WORD_OF(f) (FACE_WORDS == 1 ? 0 : (f) >> 6)

inline void add_polyhedron_face(ulong *set, int f)
{
    set[WORD_OF(f)] |= (ulong)1 << (f & 63);
}

/* The first face that is not in the set, or FACE_CAPACITY. */
inline int first_spare(const ulong *set)
{
    for (int w = 0; w < FACE_WORDS; ++w) {
        const ulong spare = ~set[w];
        if (spare != 0)
            return 64 * w + 63 - (int)clz(spare & -spare);
    }
    return FACE_CAPACITY;
}

/* The first face of the set from f on, or FACE_CAPACITY. */
inline int next_face(const ulong *set, int f)
{
    while (f < FACE_CAPACITY) {
        const ulong rest = set[WORD_OF(f)] >> (f & 63);
        if (rest != 0)
            return f + 63 - (int)clz(rest & -rest);
        f = (f | 63) + 1;
    }
    return FACE_CAPACITY;
}

/* Arrays of vertices are padded to whole vectors by zeros: the generator itself, which no bisector cuts off. */
typedef struct {
    int n;                   /* vertices */
    bool torn;               /* whether a clip kept something that it should have removed; see clip.h */
    REAL reach2;             /* largest squared distance of a vertex from the generator */
    ulong alive[FACE_WORDS]; /* set of the existing faces */
    REAL8 x[VERTEX_CAPACITY / 8], y[VERTEX_CAPACITY / 8], z[VERTEX_CAPACITY / 8];
    REAL8 beyond[VERTEX_CAPACITY / 8];       /* signed distances from a bisector, times |d| */
    INDEX4 faces[VERTEX_CAPACITY];           /* of a vertex, counter-clockwise */
    INDEX at[FACE_CAPACITY * FACE_CAPACITY]; /* [a][b]: the vertex whose faces are a, b, in this order, and another */
    int labels[FACE_CAPACITY];               /* of a face: a generator, or -1 - wall */
    REAL4 planes[FACE_CAPACITY];             /* of a face: d, level; the plane is y.d = level */
} cell_t;

#define X(cell) ((REAL *)(cell)->x)
#define Y(cell) ((REAL *)(cell)->y)
#define Z(cell) ((REAL *)(cell)->z)

/* Record vertex v between its faces. */
inline void link_vertex(cell_t *cell, int v)
{
    const INDEX4 f = cell->faces[v];
    cell->at[f.s0 * FACE_CAPACITY + f.s1] = v;
    cell->at[f.s1 * FACE_CAPACITY + f.s2] = v;
    cell->at[f.s2 * FACE_CAPACITY + f.s0] = v;
}

inline void find_reach(cell_t *cell)
{
    const int blocks = (cell->n + 7) / 8;
    REAL8 far = fma(cell->x[0], cell->x[0], fma(cell->y[0], cell->y[0], cell->z[0] * cell->z[0]));
    for (int b = 1; b < blocks; ++b) {
        const REAL8 r2 = fma(cell->x[b], cell->x[b], fma(cell->y[b], cell->y[b], cell->z[b] * cell->z[b]));
        far = r2 > far ? r2 : far;
    }
    const REAL4 half4 = far.lo > far.hi ? far.lo : far.hi;
    const REAL2 half2 = half4.lo > half4.hi ? half4.lo : half4.hi;
    cell->reach2 = half2.s0 > half2.s1 ? half2.s0 : half2.s1;
}

/* Start with the whole box around generator x. Face w is wall w. */
inline void start_polyhedron(cell_t *cell, REAL4 x, REAL4 lower, REAL4 upper)
{
    cell->n = 8;
    cell->torn = false;
    for (int k = 0; k < FACE_WORDS; ++k)
        cell->alive[k] = k == 0 ? 63 : 0;
    const REAL4 low = lower - x, high = upper - x;
    cell->x[0] = (REAL8)(low.s0, high.s0, low.s0, high.s0, low.s0, high.s0, low.s0, high.s0);
    cell->y[0] = (REAL8)(low.s1, low.s1, high.s1, high.s1, low.s1, low.s1, high.s1, high.s1);
    cell->z[0] = (REAL8)(low.s2, low.s2, low.s2, low.s2, high.s2, high.s2, high.s2, high.s2);
    for (int b = 1; b < VERTEX_CAPACITY / 8; ++b)
        cell->x[b] = cell->y[b] = cell->z[b] = 0;
    for (int v = 0; v < 8; ++v) {
        const int fx = v & 1, fy = 2 + ((v >> 1) & 1), fz = 4 + (v >> 2);
        /* Counter-clockwise for an even number of lower walls. */
        const bool turned = ((v & 1) + ((v >> 1) & 1) + (v >> 2)) % 2 == 0;
        cell->faces[v] = turned ? (INDEX4)(fx, fz, fy, 0) : (INDEX4)(fx, fy, fz, 0);
        link_vertex(cell, v);
    }
    for (int w = 0; w < 6; ++w)
        cell->labels[w] = -1 - w;
    cell->planes[0] = (REAL4)(-1, 0, 0, -low.s0);
    cell->planes[1] = (REAL4)(1, 0, 0, high.s0);
    cell->planes[2] = (REAL4)(0, -1, 0, -low.s1);
    cell->planes[3] = (REAL4)(0, 1, 0, high.s1);
    cell->planes[4] = (REAL4)(0, 0, -1, -low.s2);
    cell->planes[5] = (REAL4)(0, 0, 1, high.s2);
    find_reach(cell);
}

/* The vertex that follows v counter-clockwise around face f. */
inline int vertex_after(const cell_t *cell, int v, int f)
{
    const INDEX4 g = cell->faces[v];
    const int next = g.s0 == f ? g.s2 : (g.s1 == f ? g.s0 : g.s1);
    return cell->at[f * FACE_CAPACITY + next];
}
