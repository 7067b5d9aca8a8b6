/* Clipping a polyhedron by the bisector with a neighbor. In the dual triangulation the vertices beyond the bisector are
   triangles that form a disc. Clipping removes the disc and joins its rim to the new face. Adjacency follows from this
   structure alone, never from coordinates: Euler's formula holds whatever the round-off. */
#include "tessellation/clip_tolerance.h"
#include "tessellation/polyhedron.h"

#define CLIP_MISSED 0    /* the bisector does not cut the cell */
#define CLIP_CUT 1       /* it cuts */
#define CLIP_FULL 2      /* it cuts, and there are too many faces */
#define CLIP_COLLAPSED 3 /* round-off leaves nothing, or much on the wrong side */
#define CLIP_COINCIDE 4  /* another generator coincides with that of the cell */

/* Generators are near each other if the square of their distance is at most this share of that to the generator of the
   cell. */
#define NEAR_EACH_OTHER R(1e-3)

inline REAL4 cross_product(REAL4 a, REAL4 b)
{
    return (REAL4)(difference_of_products(a.s1, b.s2, a.s2, b.s1), difference_of_products(a.s2, b.s0, a.s0, b.s2),
                   difference_of_products(a.s0, b.s1, a.s1, b.s0), 0);
}

/* The weight of the cell's generator, and the square of the vector to the generator behind a plane. */
#ifdef WEIGHTED
#define OWN_WEIGHT(cell) (cell)->weight
#define SQUARE_OF(plane) ((plane).s0 * (plane).s0 + (plane).s1 * (plane).s1 + (plane).s2 * (plane).s2)
#else
#define OWN_WEIGHT(cell) R(0)
#define SQUARE_OF(plane) (2 * (plane).s3)
#endif

/* The plane for generator q, or instead the bisector of p and q: if these are near each other and far from the cell,
   their planes are nearly parallel, but the difference of the planes is accurate. */
inline REAL4 better_row(REAL4 q, REAL4 p, int label_q, int label_p, global const REAL *points)
{
    if (label_p < 0 || label_q < 0)
        return q;
    /* Most are surely not near each other. Their planes say so without a look at their positions. */
    const REAL near2 = NEAR_EACH_OTHER * SQUARE_OF(p);
    const REAL e0 = q.s0 - p.s0, e1 = q.s1 - p.s1, e2 = q.s2 - p.s2;
    if (e0 * e0 + e1 * e1 + e2 * e2 > 2 * near2)
        return q;
    const REAL4 w = (REAL4)(points[STRIDE * label_q] - points[STRIDE * label_p],
                            points[STRIDE * label_q + 1] - points[STRIDE * label_p + 1],
                            points[STRIDE * label_q + 2] - points[STRIDE * label_p + 2], 0);
    const REAL w2 = w.s0 * w.s0 + w.s1 * w.s1 + w.s2 * w.s2;
    if (w2 > near2)
        return q;
    const REAL level = (w2 - (WEIGHT(points, label_q) - WEIGHT(points, label_p))) / 2;
    return (REAL4)(w.s0, w.s1, w.s2, w.s0 * p.s0 + w.s1 * p.s1 + w.s2 * p.s2 + level);
}

/* The intersection of three planes. */
inline REAL4 meeting_point(const CELL *cell, int a, int b, int c, global const REAL *points)
{
    const REAL4 p = cell->planes[a];
    const REAL4 q = better_row(cell->planes[b], p, cell->labels[b], cell->labels[a], points);
    const REAL4 r0 = cell->planes[c];
    REAL4 r = better_row(r0, p, cell->labels[c], cell->labels[a], points);
    if (r.s3 == r0.s3 && r.s0 == r0.s0)
        r = better_row(r0, cell->planes[b], cell->labels[c], cell->labels[b], points);
    const REAL4 qr = cross_product(q, r), rp = cross_product(r, p), pq = cross_product(p, q);
    const REAL inverse = 1 / (p.s0 * qr.s0 + p.s1 * qr.s1 + p.s2 * qr.s2);
    return (qr * p.s3 + rp * q.s3 + pq * r.s3) * inverse;
}

/* Make the vertices beyond the bisector one disc. It grows from the farthest vertex by one triangle at a time, the
   farthest first. If it does not reach all vertices farther beyond than `doubt`, it grows through the nearest other
   vertices. The distances of vertices that change sides are corrected. False if a vertex stays out of reach, such as
   the wrong end of a slit, which is not removed. */
inline bool keep_disc(CELL *cell, REAL depth, REAL doubt)
{
    CELL_SPACE REAL *s = BEYOND(cell);
    ulong inside[VERTEX_WORDS]; /* the vertices of the disc */
    uint on[FACE_WORDS];        /* the faces around it */
    int added = 0, left = 0;    /* left: vertices surely beyond that are not in the disc */
    for (int w = 0; w < VERTEX_WORDS; ++w)
        inside[w] = 0;
    for (int w = 0; w < FACE_WORDS; ++w)
        on[w] = 0;
    for (int v = 0; v < cell->n; ++v) {
        added = s[v] > s[added] ? v : added;
        left += s[v] > doubt;
    }
    while (added >= 0) {
        const INDEX4 f = cell->faces[added];
        ADD_VERTEX(inside, added);
        ADD_FACE(on, f.s0);
        ADD_FACE(on, f.s1);
        ADD_FACE(on, f.s2);
        left -= s[added] > doubt;
        const REAL least = left > 0 ? -64 * doubt : depth;
        added = -1;
        for (int v = 0; v < cell->n; ++v) {
            if (HAS_VERTEX(inside, v) || !(s[v] > least) || (added >= 0 && !(s[v] > s[added])))
                continue;
            const INDEX4 g = cell->faces[v], links = cell->links[v];
            const int ab = HAS_VERTEX(inside, links.s0), bc = HAS_VERTEX(inside, links.s1),
                      ca = HAS_VERTEX(inside, links.s2);
            const int shared = ab + bc + ca, apart = ab ? g.s2 : (bc ? g.s0 : g.s1);
            if (shared == 2 || (shared == 1 && !HAS_FACE(on, apart)))
                added = v;
        }
    }
    for (int v = 0; v < cell->n; ++v) {
        const bool removed = HAS_VERTEX(inside, v);
        if (removed && !(s[v] > depth))
            s[v] = 2 * depth;
        if (!removed && s[v] > depth)
            s[v] = 0;
    }
    return left == 0;
}

/* Find the rim; false if it is not one simple cycle. */
inline bool find_rim(CELL *cell, REAL depth)
{
    CELL_SPACE const REAL *s = BEYOND(cell);
    CELL_SPACE rim_t *rim = &cell->rim;
    int gone = 0, n = 0;
    ulong beyond[VERTEX_WORDS];
    uint touched[FACE_WORDS], around[FACE_WORDS];
    for (int w = 0; w < VERTEX_WORDS; ++w)
        beyond[w] = 0;
    for (int w = 0; w < FACE_WORDS; ++w)
        touched[w] = around[w] = 0;
    SHORT_LOOP
    for (int v = 0; v < cell->n; ++v)
        beyond[VERTEX_WORD(v)] |= (ulong)(s[v] > depth) << (v & 63);
    for (int w = 0; w < VERTEX_WORDS; ++w) {
        rim->beyond[w] = beyond[w];
        gone += (int)popcount(beyond[w]);
    }
    rim->gone = gone;
    for (int w = 0; w < VERTEX_WORDS; ++w) {
        SHORT_LOOP
        for (ulong rest = beyond[w]; rest != 0; rest &= rest - 1) {
            const int v = 64 * w + 63 - (int)clz(rest & -rest);
            const INDEX4 f = cell->faces[v], links = cell->links[v];
            ADD_FACE(touched, f.s0);
            ADD_FACE(touched, f.s1);
            ADD_FACE(touched, f.s2);
            rim->edges[n] = (INDEX4)(f.s0, f.s1, links.s0, v);
            n += !HAS_VERTEX(beyond, links.s0);
            rim->edges[n] = (INDEX4)(f.s1, f.s2, links.s1, v);
            n += !HAS_VERTEX(beyond, links.s1);
            rim->edges[n] = (INDEX4)(f.s2, f.s0, links.s2, v);
            n += !HAS_VERTEX(beyond, links.s2);
            if (n > FACE_CAPACITY)
                return false;
        }
    }
    rim->n = n;
    SHORT_LOOP
    for (int k = 0; k < n; ++k) {
        const int face = rim->edges[k].s0;
        ADD_FACE(around, face);
        rim->edge_after[face] = k;
    }
    int faces = 0, dead = 0;
    for (int w = 0; w < FACE_WORDS; ++w) {
        const uint inner = touched[w] & ~around[w];
        rim->dead[w] = inner;
        faces += (int)popcount(around[w]);
        dead += (int)popcount(inner);
    }
    /* Simple cycles and Euler's formula prove a disc of up to six triangles. More may be a ring and a disc. */
    if (faces != n || n != gone + 2 - 2 * dead)
        return false;
    if (gone > 6) {
        int k = 0, steps = 0;
        do {
            k = rim->edge_after[rim->edges[k].s1];
            ++steps;
        } while (k != 0);
        return steps == n;
    }
    return true;
}

/* Remove the faces inside the rim and add the new face; FACE_CAPACITY if there is no room. */
inline int replace_faces(CELL *cell, int label)
{
    if (cell->n + cell->rim.n > VERTEX_CAPACITY)
        return FACE_CAPACITY;
    for (int w = 0; w < FACE_WORDS; ++w)
        cell->alive[w] &= ~cell->rim.dead[w];
    const int face = first_spare(cell);
    if (face < FACE_CAPACITY) {
        ADD_FACE(cell->alive, face);
        cell->labels[face] = label;
    }
    return face;
}

/* New vertices, after the others: intersections of the plane with the edges of the rim, by interpolation. */
inline void cut_edges(CELL *cell)
{
    CELL_SPACE REAL *x = X(cell), *y = Y(cell), *z = Z(cell), *s = BEYOND(cell);
    CELL_SPACE const rim_t *rim = &cell->rim;
    SHORT_LOOP
    for (int k = 0; k < rim->n; ++k) {
        const INDEX4 edge = rim->edges[k];
        const int in = edge.s2, out = edge.s3, v = cell->n + k;
        const REAL s_in = s[in] < 0 ? s[in] : 0;
        const REAL t = s_in / (s_in - s[out]);
        x[v] = x[in] + t * (x[out] - x[in]);
        y[v] = y[in] + t * (y[out] - y[in]);
        z[v] = z[in] + t * (z[out] - z[in]);
    }
}

/* New vertices: intersections of the planes of their faces instead, where these determine them. */
inline void meet_planes(CELL *cell, int face, REAL distance, global const REAL *points)
{
    CELL_SPACE REAL *x = X(cell), *y = Y(cell), *z = Z(cell), *s = BEYOND(cell);
    const REAL reach = distance * sqrt(cell->reach2);
    for (int k = 0; k < cell->rim.n; ++k) {
        const INDEX4 ends = cell->rim.edges[k];
        const int in = ends.s2, out = ends.s3, v = cell->n + k;
        const REAL4 corner = meeting_point(cell, ends.s0, ends.s1, face, points);
        /* But not if the plane is nearly parallel to the edge: only interpolation stays on the edge. */
        const REAL slack = 1 + reach / (s[out] - s[in]);
        const REAL off = fabs(corner.s0 - x[v]) + fabs(corner.s1 - y[v]) + fabs(corner.s2 - z[v]);
        const REAL edge = fabs(x[out] - x[in]) + fabs(y[out] - y[in]) + fabs(z[out] - z[in]);
        if (slack < 1024 && off < 1024 * REAL_EPS * (edge + sqrt(cell->reach2)) * slack) {
            x[v] = corner.s0;
            y[v] = corner.s1;
            z[v] = corner.s2;
        }
    }
}

/* Move vertex `from` to the free place `to`. */
inline void move_vertex(CELL *cell, int from, int to)
{
    const INDEX4 f = cell->faces[from], links = cell->links[from];
    X(cell)[to] = X(cell)[from];
    Y(cell)[to] = Y(cell)[from];
    Z(cell)[to] = Z(cell)[from];
    cell->faces[to] = f;
    cell->links[to] = links;
    link_vertex(cell, links.s0, f.s1, to);
    link_vertex(cell, links.s1, f.s2, to);
    link_vertex(cell, links.s2, f.s0, to);
}

/* Join the rim to the new face by the new vertices. They move to the places of the removed vertices, or else follow the
   last one; remaining gaps are filled from the end. */
inline void close_rim(CELL *cell, int face)
{
    CELL_SPACE REAL *x = X(cell), *y = Y(cell), *z = Z(cell);
    CELL_SPACE rim_t *rim = &cell->rim;
    ulong gaps[VERTEX_WORDS]; /* removed vertices that have not been replaced */
    for (int w = 0; w < VERTEX_WORDS; ++w)
        gaps[w] = rim->beyond[w];
    const int first = cell->n;
    int w = 0, end = first;
    SHORT_LOOP
    for (int k = 0; k < rim->n; ++k) {
        const INDEX4 edge = rim->edges[k];
        while (w < VERTEX_WORDS - 1 && gaps[w] == 0)
            ++w;
        const ulong left = gaps[w];
        const int v = left != 0 ? 64 * w + 63 - (int)clz(left & -left) : end++;
        gaps[w] = left & (left - 1);
        x[v] = x[first + k];
        y[v] = y[first + k];
        z[v] = z[first + k];
        rim->edges[k].s3 = v; /* instead of the removed end */
        cell->faces[v] = (INDEX4)(edge.s0, edge.s1, face, 0);
        link_vertex(cell, edge.s2, edge.s1, v);
    }
    SHORT_LOOP
    for (int k = 0; k < rim->n; ++k) {
        const INDEX4 edge = rim->edges[k];
        const int v = edge.s3, next = rim->edges[rim->edge_after[edge.s1]].s3;
        cell->links[v].s0 = edge.s2;
        cell->links[v].s1 = next;
        cell->links[next].s2 = v;
    }
    SHORT_LOOP
    for (int v = end; v < first + rim->n; ++v)
        x[v] = y[v] = z[v] = 0;
    w = VERTEX_WORDS - 1;
    SHORT_LOOP
    for (int k = rim->gone; k > rim->n; --k) {
        while (w > 0 && gaps[w] == 0)
            --w;
        const int v = 64 * w + 63 - (int)clz(gaps[w]), last = --end;
        gaps[w] ^= (ulong)1 << (v & 63);
        if (v != last)
            move_vertex(cell, last, v);
        x[last] = y[last] = z[last] = 0;
    }
    cell->n = end;
}

/* -DCLIP_SHARPLY=1: smaller parts are cut, too, as all given neighbors are known to have a face. */
#ifndef CLIP_SHARPLY
#define CLIP_SHARPLY 0
#endif

/* Empty the cell in a power diagram, where that is no error; returns CLIP_*. */
inline int nothing_left(CELL *cell)
{
#ifdef WEIGHTED
    cell->n = 0;
    cell->reach2 = 0;
    return CLIP_CUT;
#else
    return CLIP_COLLAPSED;
#endif
}

/* Clip the cell by the bisector with the neighbor at x + d: remove the points y with y.d > level, which is d.d / 2 for
   equal weights; returns CLIP_*. In a power diagram nothing may be left: the cell then has no vertices. With
   `seen_before` the cell may already have a face with this neighbor. */
inline int clip_polyhedron(CELL *cell, REAL4 d, REAL d2, int label, bool seen_before, global const REAL *points)
{
    const REAL level = (d2 - (WEIGHT(points, label) - OWN_WEIGHT(cell))) / 2;
    REALS far = -level;
    SHORT_LOOP
    for (int b = 0; CELL_LANES * b < cell->n; ++b) {
        const REALS s = fma(cell->x[b], d.s0, fma(cell->y[b], d.s1, fma(cell->z[b], d.s2, -level)));
        cell->beyond[b] = s;
        far = s > far ? s : far;
    }
    const REAL farthest = largest_of(far);
    /* Most bisectors miss the cell: avoid the square root. */
    if (!(farthest > (CLIP_SHARPLY ? 0 : 4 * REAL_EPS * d2)))
        return CLIP_MISSED;
    const REAL distance = sqrt(d2), depth = CLIP_SHARPLY ? 0 : distance * noise_length(distance);
    if (!(farthest > depth))
        return CLIP_MISSED;
    if (seen_before)
        for (int f = next_face(cell, 0); f < FACE_CAPACITY; f = next_face(cell, f + 1))
            if (cell->labels[f] == label)
                return CLIP_MISSED;

    if (!find_rim(cell, depth)) {
        if (cell->rim.gone == cell->n)
            return nothing_left(cell);
        const REAL doubt = 64 * distance * (noise_length(distance) + REAL_EPS * sqrt(cell->reach2));
        cell->torn |= !keep_disc(cell, depth, doubt);
        if (!find_rim(cell, depth)) {
            cell->torn = true;
            return nothing_left(cell);
        }
    }
    const int face = replace_faces(cell, label);
    if (face == FACE_CAPACITY)
        return CLIP_FULL;
    cell->planes[face] = (REAL4)(d.s0, d.s1, d.s2, level);

    /* Interpolation has an error of eps times the length of the edge. If this is large compared with the distance of
       the generators (an open cell, or near-duplicates), the planes are intersected instead. */
    cut_edges(cell);
    if (cell->reach2 > 16 * d2)
        meet_planes(cell, face, distance, points);
    close_rim(cell, face);
    find_reach(cell);
    return CLIP_CUT;
}

/* Start the cell of generator i at x: the clip box, cut by the planes of its own; returns CLIP_*. */
inline int start_cell(CELL *cell, int i, REAL4 x, global const REAL *points, CLIP_BOX_ARGS)
{
    start_polyhedron(cell, x, box_lower, box_upper);
    if (!WALLS_MOVE)
        return CLIP_CUT;
    const own_t own = OWN_OF(i);
    for (int k = 0; k < own_count(&own); ++k) {
        /* The bisector with the mirror image. */
        const REAL4 plane = own_plane(&own, k), d = (REAL4)(plane.s0, plane.s1, plane.s2, 0) * (2 * plane.s3);
        const int what = clip_polyhedron(cell, d, 4 * plane.s3 * plane.s3, own_label(&own, k), false, points);
        if (what >= CLIP_FULL)
            return what;
    }
    return CLIP_CUT;
}

/* Clip by the generators in row i of a graph; returns CLIP_*. */
inline int clip_polyhedron_by_row(CELL *cell, int i, REAL4 x, global const int *starts, global const int *neighbors,
                                  global const REAL *points)
{
    const int end = starts[i + 1];
    for (int k = starts[i]; k < end; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const REAL4 d =
            (REAL4)(points[STRIDE * j] - x.s0, points[STRIDE * j + 1] - x.s1, points[STRIDE * j + 2] - x.s2, 0);
        const REAL d2 = d.s0 * d.s0 + d.s1 * d.s1 + d.s2 * d.s2;
        const int what = d2 == 0 ? CLIP_COINCIDE : clip_polyhedron(cell, d, d2, j, false, points);
        if (what >= CLIP_FULL)
            return what;
    }
    return CLIP_CUT;
}
