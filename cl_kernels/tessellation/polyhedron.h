/* A convex polyhedron around its generator. Coordinates are relative to the generator: differences of close positions
   are exact, so cells of any size are accurate.

   The polyhedron is simple: three faces meet in every vertex (where more do, vertices coincide). Its dual is a
   triangulated sphere: a vertex is the triangle of its three faces, counter-clockwise seen from outside. */
#include "geometry/weights.h"
#include "tessellation/own_planes.h"

#ifndef FACE_CAPACITY
#error "build with -DFACE_CAPACITY=faces that a cell may have while it is clipped, a multiple of 32"
#endif
/* Vertices at a time: eight in the lanes of a vector on CPUs; one on other devices, which have few registers. */
#if GROUP_SIZE == 1
#define CELL_LANES 8
#define REALS CLVORO_JOIN(REAL, 8)
#else
#define CELL_LANES 1
#define REALS REAL
#endif
/* F faces have 2 F - 4 vertices, and up to F new ones beside them while they are clipped. In private memory there is
   room for few new ones: a cell that needs more counts as full. */
#ifdef CELL_BYTES
#define VERTEX_CAPACITY (3 * FACE_CAPACITY)
#else
#define VERTEX_CAPACITY (2 * FACE_CAPACITY)
#endif
#if VERTEX_CAPACITY <= 256
#define INDEX uchar
#define INDEX4 uchar4
#else
#define INDEX ushort
#define INDEX4 ushort4
#endif

/* Sets of faces are words of 32 bits, sets of vertices words of 64 bits. */
#define FACE_WORDS (FACE_CAPACITY / 32)
#define FACE_WORD(f) (FACE_WORDS == 1 ? 0 : (f) >> 5)
#define ADD_FACE(set, f) ((set)[FACE_WORD(f)] |= (uint)1 << ((f)&31))
#define HAS_FACE(set, f) (((set)[FACE_WORD(f)] >> ((f)&31)) & 1)
#define VERTEX_WORDS (VERTEX_CAPACITY / 64)
#define VERTEX_WORD(v) (VERTEX_WORDS == 1 ? 0 : (v) >> 6)
#define ADD_VERTEX(set, v) ((set)[VERTEX_WORD(v)] |= (ulong)1 << ((v)&63))
#define HAS_VERTEX(set, v) (((set)[VERTEX_WORD(v)] >> ((v)&63)) & 1)

#include "tessellation/cell_space.h"
#define CELL CELL_SPACE cell_t

/* The edges of the cell that a bisector cuts. */
typedef struct {
    int gone;                        /* vertices beyond the bisector */
    int n;                           /* edges */
    ulong beyond[VERTEX_WORDS];      /* set of the vertices beyond */
    uint dead[FACE_WORDS];           /* set of the faces entirely beyond */
    INDEX4 edges[FACE_CAPACITY + 4]; /* the two faces of an edge, along the rim; its ends, kept and removed */
    INDEX edge_after[FACE_CAPACITY]; /* the edge that follows a face along the rim */
} rim_t;

/* Arrays of vertices are padded to whole vectors by zeros: the generator itself, which no bisector cuts off. */
typedef struct {
    REALS x[VERTEX_CAPACITY / CELL_LANES], y[VERTEX_CAPACITY / CELL_LANES], z[VERTEX_CAPACITY / CELL_LANES];
    REALS beyond[VERTEX_CAPACITY / CELL_LANES]; /* signed distances from a bisector, times |d| */
    REAL4 planes[FACE_CAPACITY];                /* of a face: d, level; the plane is y.d = level */
    int labels[FACE_CAPACITY];                  /* of a face: a generator, -1 - wall, or a side of the clip box */
    INDEX4 faces[VERTEX_CAPACITY];              /* of a vertex, counter-clockwise: a, b, c */
    INDEX4 links[VERTEX_CAPACITY]; /* of a vertex: the other ends of the edges between a and b, b and c, c and a */
    int n;                         /* vertices */
    bool torn;                     /* whether a clip kept something that it should have removed; see clip.h */
    REAL reach2;                   /* largest squared distance of a vertex from the generator */
#ifdef WEIGHTED
    REAL weight; /* of the generator */
    REAL most;   /* largest difference of the weight of a generator that is searched from this one */
#endif
    uint alive[FACE_WORDS]; /* set of the existing faces */
    rim_t rim;
} cell_t;

#ifdef CELL_BYTES
typedef char CELL_BYTES_suffice[sizeof(cell_t) <= CELL_BYTES ? 1 : -1];
#endif

#define X(cell) ((CELL_SPACE REAL *)(cell)->x)
#define Y(cell) ((CELL_SPACE REAL *)(cell)->y)
#define Z(cell) ((CELL_SPACE REAL *)(cell)->z)
#define BEYOND(cell) ((CELL_SPACE REAL *)(cell)->beyond)

/* The first face that does not exist, or FACE_CAPACITY. */
inline int first_spare(const CELL *cell)
{
    for (int w = 0; w < FACE_WORDS; ++w) {
        const uint spare = ~cell->alive[w];
        if (spare != 0)
            return 32 * w + 31 - (int)clz(spare & -spare);
    }
    return FACE_CAPACITY;
}

/* The first face from f on, or FACE_CAPACITY. */
inline int next_face(const CELL *cell, int f)
{
    while (f < FACE_CAPACITY) {
        const uint rest = cell->alive[FACE_WORD(f)] >> (f & 31);
        if (rest != 0)
            return f + 31 - (int)clz(rest & -rest);
        f = (f | 31) + 1;
    }
    return FACE_CAPACITY;
}

/* The number of faces before face f. */
inline int face_number(const CELL *cell, int f)
{
    int number = popcount(cell->alive[FACE_WORD(f)] & (((uint)1 << (f & 31)) - 1));
    for (int w = 0; w < FACE_WORD(f); ++w)
        number += popcount(cell->alive[w]);
    return number;
}

/* A vertex of every face, in the memory of the rim. */
inline CELL_SPACE INDEX *face_starts(CELL *cell)
{
    CELL_SPACE INDEX *start = cell->rim.edge_after;
    SHORT_LOOP
    for (int v = 0; v < cell->n; ++v) {
        const INDEX4 f = cell->faces[v];
        start[f.s0] = start[f.s1] = start[f.s2] = v;
    }
    return start;
}

/* Let vertex v be the other end of the edge of vertex w between its face `first` and the following one. */
inline void link_vertex(CELL *cell, int w, int first, int v)
{
    const INDEX4 f = cell->faces[w];
    const int k = f.s0 == first ? 0 : (f.s1 == first ? 1 : 2);
    ((CELL_SPACE INDEX *)(cell->links + w))[k] = v;
}

inline REAL largest_of(REALS v)
{
#if CELL_LANES == 1
    return v;
#else
    const REAL4 half4 = v.lo > v.hi ? v.lo : v.hi;
    const REAL2 half2 = half4.lo > half4.hi ? half4.lo : half4.hi;
    return half2.s0 > half2.s1 ? half2.s0 : half2.s1;
#endif
}

inline void find_reach(CELL *cell)
{
    REALS far = 0;
    SHORT_LOOP
    for (int b = 0; CELL_LANES * b < cell->n; ++b) {
        const REALS r2 = fma(cell->x[b], cell->x[b], fma(cell->y[b], cell->y[b], cell->z[b] * cell->z[b]));
        far = r2 > far ? r2 : far;
    }
    cell->reach2 = largest_of(far);
}

/* The position of generator i, and its weight. */
#define SITE_IN_SPACE(points, i)                                                                                       \
    (REAL4)((points)[STRIDE * (i)], (points)[STRIDE * (i) + 1], (points)[STRIDE * (i) + 2], WEIGHT(points, i))

/* Vertex v of 8 of the box from `low` to `high`, its faces and links. */
inline void start_vertex(CELL *cell, int v, REAL4 low, REAL4 high)
{
    X(cell)[v] = v & 1 ? high.s0 : low.s0;
    Y(cell)[v] = v & 2 ? high.s1 : low.s1;
    Z(cell)[v] = v & 4 ? high.s2 : low.s2;
    const int fx = v & 1, fy = 2 + ((v >> 1) & 1), fz = 4 + (v >> 2);
    /* Counter-clockwise for an even number of lower walls. */
    const bool turned = ((v & 1) + ((v >> 1) & 1) + (v >> 2)) % 2 == 0;
    cell->faces[v] = turned ? (INDEX4)(fx, fz, fy, 0) : (INDEX4)(fx, fy, fz, 0);
    const int along_x = v ^ 1, along_y = v ^ 2, along_z = v ^ 4;
    cell->links[v] = turned ? (INDEX4)(along_y, along_x, along_z, 0) : (INDEX4)(along_z, along_x, along_y, 0);
}

/* Start with the whole box around generator x. Face w is wall w. */
inline void start_polyhedron(CELL *cell, REAL4 x, REAL4 lower, REAL4 upper)
{
#ifdef WEIGHTED
    cell->weight = x.s3;
#endif
    cell->n = 8;
    cell->torn = false;
    for (int k = 0; k < FACE_WORDS; ++k)
        cell->alive[k] = k == 0 ? 63 : 0;
    const REAL4 low = lower - x, high = upper - x;
    SHORT_LOOP
    for (int b = 8 / CELL_LANES; b < VERTEX_CAPACITY / CELL_LANES; ++b)
        cell->x[b] = cell->y[b] = cell->z[b] = 0;
    SHORT_LOOP
    for (int v = 0; v < 8; ++v)
        start_vertex(cell, v, low, high);
    for (int w = 0; w < 6; ++w)
        cell->labels[w] = BOX_LABEL(w);
    cell->planes[0] = (REAL4)(-1, 0, 0, -low.s0);
    cell->planes[1] = (REAL4)(1, 0, 0, high.s0);
    cell->planes[2] = (REAL4)(0, -1, 0, -low.s1);
    cell->planes[3] = (REAL4)(0, 1, 0, high.s1);
    cell->planes[4] = (REAL4)(0, 0, -1, -low.s2);
    cell->planes[5] = (REAL4)(0, 0, 1, high.s2);
    find_reach(cell);
}

/* The vertex that follows v counter-clockwise around face f. */
inline int vertex_after(const CELL *cell, int v, int f)
{
    const INDEX4 g = cell->faces[v], links = cell->links[v];
    return g.s0 == f ? links.s2 : (g.s1 == f ? links.s0 : links.s1);
}
