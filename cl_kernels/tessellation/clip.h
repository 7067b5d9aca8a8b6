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

/* The plane for generator q, or instead the bisector of p and q: if these are near each other and far from the cell,
   their planes are nearly parallel, but the difference of the planes is accurate. */
inline REAL4 better_row(REAL4 q, REAL4 p, int label_q, int label_p, global const REAL *points)
{
    if (label_p < 0 || label_q < 0)
        return q;
    const REAL4 w =
        (REAL4)(points[3 * label_q] - points[3 * label_p], points[3 * label_q + 1] - points[3 * label_p + 1],
                points[3 * label_q + 2] - points[3 * label_p + 2], 0);
    const REAL w2 = w.s0 * w.s0 + w.s1 * w.s1 + w.s2 * w.s2;
    if (w2 > 2 * NEAR_EACH_OTHER * p.s3) /* level is half a square */
        return q;
    return (REAL4)(w.s0, w.s1, w.s2, w.s0 * p.s0 + w.s1 * p.s1 + w.s2 * p.s2 + w2 / 2);
}

/* The intersection of three planes. */
inline REAL4 meeting_point(const cell_t *cell, int a, int b, int c, global const REAL *points)
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
inline bool keep_disc(cell_t *cell, REAL depth, REAL doubt)
{
    REAL *s = (REAL *)cell->beyond;
    bool inside[VERTEX_CAPACITY], on[FACE_CAPACITY]; /* whether a vertex, a face belongs to the disc */
    int added = 0, left = 0;                         /* left: vertices surely beyond that are not in the disc */
    for (int v = 0; v < cell->n; ++v) {
        inside[v] = false;
        added = s[v] > s[added] ? v : added;
        left += s[v] > doubt;
    }
    for (int f = 0; f < FACE_CAPACITY; ++f)
        on[f] = false;
    while (added >= 0) {
        const INDEX4 f = cell->faces[added];
        inside[added] = on[f.s0] = on[f.s1] = on[f.s2] = true;
        left -= s[added] > doubt;
        const REAL least = left > 0 ? -64 * doubt : depth;
        added = -1;
        for (int v = 0; v < cell->n; ++v) {
            if (inside[v] || !(s[v] > least) || (added >= 0 && !(s[v] > s[added])))
                continue;
            const INDEX4 g = cell->faces[v];
            const bool ab = inside[cell->at[g.s1 * FACE_CAPACITY + g.s0]];
            const bool bc = inside[cell->at[g.s2 * FACE_CAPACITY + g.s1]];
            const bool ca = inside[cell->at[g.s0 * FACE_CAPACITY + g.s2]];
            const int shared = ab + bc + ca;
            if (shared == 2 || (shared == 1 && !on[ab ? g.s2 : (bc ? g.s0 : g.s1)]))
                added = v;
        }
    }
    for (int v = 0; v < cell->n; ++v) {
        if (inside[v] && !(s[v] > depth))
            s[v] = 2 * depth;
        if (!inside[v] && s[v] > depth)
            s[v] = 0;
    }
    return left == 0;
}

/* The edges of the cell that a bisector cuts. */
typedef struct {
    int gone;                                                  /* vertices beyond the bisector */
    int n;                                                     /* edges */
    ulong dead[FACE_WORDS];                                    /* faces entirely beyond */
    INDEX vertices[VERTEX_CAPACITY + 1];                       /* vertices beyond, ascending */
    INDEX before[FACE_CAPACITY + 4], after[FACE_CAPACITY + 4]; /* faces of an edge, along the rim */
    INDEX in[FACE_CAPACITY + 4], out[FACE_CAPACITY + 4];       /* its ends, kept and removed */
} rim_t;

/* Find the rim; false if it is not one simple cycle. */
inline bool find_rim(const cell_t *cell, REAL depth, rim_t *rim)
{
    const REAL *s = (const REAL *)cell->beyond;
    int gone = 0, n = 0;
    SHORT_LOOP
    for (int v = 0; v < cell->n; ++v) {
        rim->vertices[gone] = v;
        gone += s[v] > depth;
    }
    rim->gone = gone;
    ulong touched[FACE_WORDS], around[FACE_WORDS];
    for (int w = 0; w < FACE_WORDS; ++w)
        touched[w] = around[w] = 0;
    SHORT_LOOP
    for (int k = 0; k < gone; ++k) {
        const int v = rim->vertices[k];
        const INDEX4 f = cell->faces[v];
        const int a = f.s0, b = f.s1, c = f.s2;
        add_polyhedron_face(touched, a);
        add_polyhedron_face(touched, b);
        add_polyhedron_face(touched, c);
        const int ab = cell->at[b * FACE_CAPACITY + a];
        rim->before[n] = a;
        rim->after[n] = b;
        rim->in[n] = ab;
        rim->out[n] = v;
        n += !(s[ab] > depth);
        const int bc = cell->at[c * FACE_CAPACITY + b];
        rim->before[n] = b;
        rim->after[n] = c;
        rim->in[n] = bc;
        rim->out[n] = v;
        n += !(s[bc] > depth);
        const int ca = cell->at[a * FACE_CAPACITY + c];
        rim->before[n] = c;
        rim->after[n] = a;
        rim->in[n] = ca;
        rim->out[n] = v;
        n += !(s[ca] > depth);
        if (n > FACE_CAPACITY)
            return false;
    }
    rim->n = n;
    SHORT_LOOP
    for (int k = 0; k < n; ++k)
        add_polyhedron_face(around, rim->before[k]);
    int faces = 0, dead = 0;
    for (int w = 0; w < FACE_WORDS; ++w) {
        rim->dead[w] = touched[w] & ~around[w];
        faces += (int)popcount(around[w]);
        dead += (int)popcount(rim->dead[w]);
    }
    /* Simple cycles and Euler's formula prove a disc of up to six triangles. More may be a ring and a disc. */
    if (faces != n || n != gone + 2 - 2 * dead)
        return false;
    if (gone > 6) {
        INDEX next[FACE_CAPACITY];
        SHORT_LOOP
        for (int k = 0; k < n; ++k)
            next[rim->before[k]] = rim->after[k];
        int face = next[rim->before[0]], steps = 1;
        while (face != rim->before[0]) {
            face = next[face];
            ++steps;
        }
        return steps == n;
    }
    return true;
}

/* Remove the faces inside the rim and add the new face; FACE_CAPACITY if there is no room. */
inline int replace_faces(cell_t *cell, const rim_t *rim, int label)
{
    for (int w = 0; w < FACE_WORDS; ++w)
        cell->alive[w] &= ~rim->dead[w];
    const int face = first_spare(cell->alive);
    if (face < FACE_CAPACITY) {
        add_polyhedron_face(cell->alive, face);
        cell->labels[face] = label;
    }
    return face;
}

/* New vertices: intersections of the plane with the edges of the rim, by interpolation. */
inline void cut_edges(const cell_t *cell, const rim_t *rim, REAL *nx, REAL *ny, REAL *nz)
{
    const REAL *x = X(cell), *y = Y(cell), *z = Z(cell), *s = (const REAL *)cell->beyond;
    SHORT_LOOP
    for (int k = 0; k < rim->n; ++k) {
        const int in = rim->in[k], out = rim->out[k];
        const REAL s_in = s[in] < 0 ? s[in] : 0;
        const REAL t = s_in / (s_in - s[out]);
        nx[k] = x[in] + t * (x[out] - x[in]);
        ny[k] = y[in] + t * (y[out] - y[in]);
        nz[k] = z[in] + t * (z[out] - z[in]);
    }
}

/* Join the rim to the new face by the new vertices. They replace the removed vertices, and then follow the last one;
   remaining gaps are filled from the end. */
inline void close_rim(cell_t *cell, const rim_t *rim, int face, const REAL *nx, const REAL *ny, const REAL *nz)
{
    REAL *x = X(cell), *y = Y(cell), *z = Z(cell);
    SHORT_LOOP
    for (int k = 0; k < rim->n; ++k) {
        const int v = k < rim->gone ? rim->vertices[k] : cell->n++;
        x[v] = nx[k];
        y[v] = ny[k];
        z[v] = nz[k];
        cell->faces[v] = (INDEX4)(rim->before[k], rim->after[k], face, 0);
        link_vertex(cell, v);
    }
    SHORT_LOOP
    for (int k = rim->gone - 1; k >= rim->n; --k) {
        const int v = rim->vertices[k], last = --cell->n;
        if (v != last) {
            x[v] = x[last];
            y[v] = y[last];
            z[v] = z[last];
            cell->faces[v] = cell->faces[last];
            link_vertex(cell, v);
        }
        x[last] = y[last] = z[last] = 0;
    }
}

/* -DCLIP_SHARPLY=1: smaller parts are cut, too, as all given neighbors are known to have a face. */
#ifndef CLIP_SHARPLY
#define CLIP_SHARPLY 0
#endif

/* Clip the cell by the bisector with the neighbor at x + d: remove the points y with y.d > d.d / 2; returns CLIP_*.
   With `seen_before` the cell may already have a face with this neighbor. */
inline int clip_polyhedron(cell_t *cell, REAL4 d, REAL d2, int label, bool seen_before, global const REAL *points)
{
    const REAL level = d2 / 2;
    const int blocks = (cell->n + 7) / 8;
    REAL8 far = -level;
    for (int b = 0; b < blocks; ++b) {
        const REAL8 s = fma(cell->x[b], d.s0, fma(cell->y[b], d.s1, fma(cell->z[b], d.s2, -level)));
        cell->beyond[b] = s;
        far = s > far ? s : far;
    }
    const REAL4 far4 = far.lo > far.hi ? far.lo : far.hi;
    const REAL2 far2 = far4.lo > far4.hi ? far4.lo : far4.hi;
    const REAL farthest = far2.s0 > far2.s1 ? far2.s0 : far2.s1;
    /* Most bisectors miss the cell: avoid the square root. */
    if (!(farthest > (CLIP_SHARPLY ? 0 : 4 * REAL_EPS * d2)))
        return CLIP_MISSED;
    const REAL distance = sqrt(d2), depth = CLIP_SHARPLY ? 0 : distance * noise_length(distance);
    if (!(farthest > depth))
        return CLIP_MISSED;
    if (seen_before)
        for (int f = next_face(cell->alive, 0); f < FACE_CAPACITY; f = next_face(cell->alive, f + 1))
            if (cell->labels[f] == label)
                return CLIP_MISSED;

    rim_t rim;
    if (!find_rim(cell, depth, &rim)) {
        if (rim.gone == cell->n)
            return CLIP_COLLAPSED;
        const REAL doubt = 64 * distance * (noise_length(distance) + REAL_EPS * sqrt(cell->reach2));
        cell->torn |= !keep_disc(cell, depth, doubt);
        if (!find_rim(cell, depth, &rim))
            return CLIP_COLLAPSED;
    }
    const int face = replace_faces(cell, &rim, label);
    if (face == FACE_CAPACITY)
        return CLIP_FULL;
    cell->planes[face] = (REAL4)(d.s0, d.s1, d.s2, level);

    /* Interpolation has an error of eps times the length of the edge. If this is large compared with the distance of
       the generators (an open cell, or near-duplicates), the planes are intersected instead. */
    REAL nx[VERTEX_CAPACITY], ny[VERTEX_CAPACITY], nz[VERTEX_CAPACITY];
    cut_edges(cell, &rim, nx, ny, nz);
    if (cell->reach2 > 16 * d2) {
        const REAL *x = X(cell), *y = Y(cell), *z = Z(cell), *s = (const REAL *)cell->beyond;
        const REAL reach = distance * sqrt(cell->reach2);
        for (int k = 0; k < rim.n; ++k) {
            const int in = rim.in[k], out = rim.out[k];
            const REAL4 v = meeting_point(cell, rim.before[k], rim.after[k], face, points);
            /* But not if the plane is nearly parallel to the edge: only interpolation stays on the edge. */
            const REAL slack = 1 + reach / (s[out] - s[in]);
            const REAL off = fabs(v.s0 - nx[k]) + fabs(v.s1 - ny[k]) + fabs(v.s2 - nz[k]);
            const REAL edge = fabs(x[out] - x[in]) + fabs(y[out] - y[in]) + fabs(z[out] - z[in]);
            if (slack < 1024 && off < 1024 * REAL_EPS * (edge + sqrt(cell->reach2)) * slack) {
                nx[k] = v.s0;
                ny[k] = v.s1;
                nz[k] = v.s2;
            }
        }
    }
    close_rim(cell, &rim, face, nx, ny, nz);
    find_reach(cell);
    return CLIP_CUT;
}

/* Clip by the generators in row i of a graph; returns CLIP_*. */
inline int clip_polyhedron_by_row(cell_t *cell, int i, REAL4 x, global const int *starts, global const int *neighbors,
                                  global const REAL *points)
{
    const int end = starts[i + 1];
    for (int k = starts[i]; k < end; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        const REAL4 d = (REAL4)(points[3 * j] - x.s0, points[3 * j + 1] - x.s1, points[3 * j + 2] - x.s2, 0);
        const REAL d2 = d.s0 * d.s0 + d.s1 * d.s1 + d.s2 * d.s2;
        const int what = d2 == 0 ? CLIP_COINCIDE : clip_polyhedron(cell, d, d2, j, false, points);
        if (what >= CLIP_FULL)
            return what;
    }
    return CLIP_CUT;
}
