/* A mesh as convex pieces of its cells, and what half-spaces { y : y.normal <= level } leave of a piece. Coordinates
   are those of a chart: relative to the origin of the piece; on a sphere in the tangent plane there, onto which the
   sphere is projected from its center, so that great circles become straight lines. A vector is a REAL4.

   piece_t                  a convex polygon or polyhedron
   build_piece              make piece i of a mesh
   note_piece, recall_piece copy a piece to and from the memory of a shape_t
   cut_piece                intersect with one half-space
   half_space               the k-th half-space that bounds a piece of another mesh
   measure_piece            compute volume and centroid, on a sphere the mean of the position in space
   bound_piece              compute a box around it */
#include "geometry/site.h"
#if CELL_DIM == 3
#include "tessellation/clip.h"
#else
#include "tessellation/sphere_arcs.h"
#endif

#define PIECE_WHOLE 0  /* the half-space contains the piece */
#define PIECE_CUT 1    /* a part was cut off */
#define PIECE_EMPTY 2  /* nothing is left */
#define PIECE_FULL 3   /* the piece has more faces than its arrays hold */
#define PIECE_BROKEN 4 /* round-off leaves no valid polyhedron */

/* The pieces of a mesh. Row i of `starts` and `items` has the corners of piece i among `points`, counter-clockwise; in
   3D it has generators, or points behind walls, and the piece is { y : |y - origin| <= |y - point| for all of them }.
 */
typedef struct {
    global const REAL *origins, *points;
    global const int *starts, *items;
} pieces_t;

#define PIECES_ARGS                                                                                                    \
    global const REAL *origins, global const REAL *points, global const int *starts, global const int *items
#define OLD_PIECES_ARGS                                                                                                \
    global const REAL *old_origins, global const REAL *old_points, global const int *old_starts,                       \
        global const int *old_items

inline REAL4 load_vector(global const REAL *points, size_t i)
{
#if DIM == 2
    return (REAL4)(points[2 * i], points[2 * i + 1], 0, 0);
#else
    return (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
#endif
}

inline void store_vector(REAL4 v, global REAL *points, size_t i)
{
    points[DIM * i] = v.s0;
    points[DIM * i + 1] = v.s1;
#if DIM == 3
    points[DIM * i + 2] = v.s2;
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

/* At least the length of a vector, and at most twice as much. */
inline REAL length_bound(REAL4 a)
{
    return fabs(a.s0) + fabs(a.s1) + fabs(a.s2);
}

/* Where a piece is cut: around `at`; on a sphere along two tangents. */
typedef struct {
    REAL4 at;
#ifdef SPHERE
    REAL4 one, other;
#endif
} chart_t;

inline chart_t chart_at(global const REAL *origins, int i)
{
    chart_t chart;
    chart.at = load_vector(origins, i);
#ifdef SPHERE
    SITE(x, i, origins);
    chart.one = (REAL4)(x[3], x[4], x[5], 0);
    chart.other = (REAL4)(x[6], x[7], x[8], 0);
#endif
    return chart;
}

/* The half-space { y : y.normal <= level }; if `turned`, the one beyond the same plane. Both pieces of a face compute
   its plane by the same operations, so that their half-spaces are complementary. The last component of the result is
   the round-off of y.normal - level for |y| <= reach and a plane through or between a and b, `length` apart: corners
   beyond the plane by no more count as inside. */
inline REAL4 side_of_plane(REAL4 normal, private REAL *level, bool turned, REAL length, REAL reach, REAL4 a, REAL4 b)
{
    if (turned) {
        normal = -normal;
        *level = -*level;
    }
    normal.s3 = 4 * REAL_EPS * length * (reach + fmax(length_bound(a), length_bound(b)));
    return normal;
}

#if CELL_DIM == 2

typedef struct {
    int n;
    REAL x[CELL_CAPACITY], y[CELL_CAPACITY];
} piece_t;

typedef piece_t shape_t;

inline REAL4 corner_of(private const piece_t *piece, int k)
{
    return (REAL4)(piece->x[k], piece->y[k], 0, 0);
}

inline void note_piece(private shape_t *shape, private const piece_t *piece)
{
    shape->n = piece->n;
    for (int k = 0; k < piece->n; ++k) {
        shape->x[k] = piece->x[k];
        shape->y[k] = piece->y[k];
    }
}

inline void recall_piece(private piece_t *piece, private const shape_t *shape)
{
    note_piece(piece, shape);
}

inline int build_piece(private piece_t *piece, const chart_t *chart, int i, const pieces_t *mesh, REAL4 box_lower,
                       REAL4 box_upper)
{
    const int start = mesh->starts[i];
    piece->n = mesh->starts[i + 1] - start;
    if (piece->n > CELL_CAPACITY)
        return PIECE_FULL;
    for (int k = 0; k < piece->n; ++k) {
        const REAL4 d = load_vector(mesh->points, mesh->items[start + k]) - chart->at;
#ifdef SPHERE
        const REAL height = 1 + dot_vectors(d, chart->at);
        piece->x[k] = dot_vectors(d, chart->one) / height;
        piece->y[k] = dot_vectors(d, chart->other) / height;
#else
        piece->x[k] = d.s0;
        piece->y[k] = d.s1;
#endif
    }
    return PIECE_WHOLE;
}

/* The half-space of the edge from corner k of piece j, moved by `shift`. On a sphere it is bounded by a plane through
   the center, with the normal v x w for the ends v = x + a and w = x + b of the edge: a x b + x x (b - a) loses no
   digits of short edges. */
inline REAL4 half_space(const chart_t *chart, REAL reach, const pieces_t *mesh, int j, int k, REAL4 shift,
                        private REAL *level)
{
    const int last = mesh->starts[j + 1] - 1;
    const REAL4 from = load_vector(mesh->points, mesh->items[k]);
    const REAL4 to = load_vector(mesh->points, mesh->items[k == last ? mesh->starts[j] : k + 1]);
    bool turned = from.s0 > to.s0 || (from.s0 == to.s0 && from.s1 > to.s1);
#ifdef SPHERE
    turned = turned || (from.s0 == to.s0 && from.s1 == to.s1 && from.s2 > to.s2);
#endif
    const REAL4 a = (turned ? to : from) + shift - chart->at, b = (turned ? from : to) + shift - chart->at;
    const REAL4 e = b - a;
#ifdef SPHERE
    const REAL4 ab = cross(a, b), normal4 = -ab - cross(chart->at, e);
    const REAL4 normal = (REAL4)(dot_vectors(normal4, chart->one), dot_vectors(normal4, chart->other), 0, 0);
    *level = dot_vectors(ab, chart->at);
#else
    const REAL4 normal = (REAL4)(e.s1, -e.s0, 0, 0);
    *level = difference_of_products(a.s0, e.s1, a.s1, e.s0);
#endif
    return side_of_plane(normal, level, turned, length_bound(e), reach, a, b);
}

/* How many corners of a shape are beyond a half-space. */
inline int count_beyond(private const shape_t *shape, REAL4 normal, REAL level)
{
    int beyond = 0;
    for (int k = 0; k < shape->n; ++k)
        beyond += shape->x[k] * normal.s0 + shape->y[k] * normal.s1 - level > normal.s3;
    return beyond;
}

inline int cut_piece(private piece_t *piece, REAL4 normal, REAL level)
{
    const int n = piece->n;
    REAL s[CELL_CAPACITY];
    int beyond = 0;
    for (int k = 0; k < n; ++k) {
        s[k] = piece->x[k] * normal.s0 + piece->y[k] * normal.s1 - level;
        beyond += s[k] > normal.s3;
    }
    if (beyond == 0)
        return PIECE_WHOLE;
    if (beyond == n)
        return PIECE_EMPTY;
    REAL x[CELL_CAPACITY], y[CELL_CAPACITY];
    int count = 0;
    for (int k = 0; k < n; ++k) {
        const int next = k == n - 1 ? 0 : k + 1;
        const bool in = !(s[k] > normal.s3), next_in = !(s[next] > normal.s3);
        if (count > CELL_CAPACITY - 2)
            return PIECE_FULL;
        if (in) {
            x[count] = piece->x[k];
            y[count++] = piece->y[k];
        }
        if (in != next_in) {
            const REAL s_in = fmin(in ? s[k] : s[next], R(0)), s_out = in ? s[next] : s[k];
            const int a = in ? k : next, b = in ? next : k;
            const REAL t = s_in / (s_in - s_out);
            x[count] = piece->x[a] + t * (piece->x[b] - piece->x[a]);
            y[count++] = piece->y[a] + t * (piece->y[b] - piece->y[a]);
        }
    }
    for (int k = 0; k < count; ++k) {
        piece->x[k] = x[k];
        piece->y[k] = y[k];
    }
    piece->n = count;
    return PIECE_CUT;
}

#ifdef SPHERE
/* Of the vector from the origin of a chart to the point of the sphere above corner k: its component along the radius,
   which is negative. *length is that of the vector to the corner itself. */
inline REAL sink_of(private const piece_t *piece, int k, private REAL *length)
{
    const REAL p2 = piece->x[k] * piece->x[k] + piece->y[k] * piece->y[k];
    *length = sqrt(1 + p2);
    return -p2 / (*length * (1 + *length));
}

/* The area is the sum of triangles around corner 0 (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125).
   The integral of the position y is half the sum over the edges, from v to w, of arc n, with n the unit vector along
   v x w (Gauss). Of the vectors v x w the parts with the origin x add up to zero. Without them small pieces lose no
   digits of the integral of y - x. */
inline REAL measure_piece(private const piece_t *piece, const chart_t *chart, private REAL4 *centroid)
{
    const REAL2 o = (REAL2)(piece->x[0], piece->y[0]);
    const REAL o_length = sqrt(1 + dot(o, o));
    REAL sum = 0, one = 0, other = 0, radial = 0;
    for (int k = 0; k < piece->n; ++k) {
        const int next = k == piece->n - 1 ? 0 : k + 1;
        const REAL2 p = (REAL2)(piece->x[k], piece->y[k]), q = (REAL2)(piece->x[next], piece->y[next]);
        REAL lp, lq;
        const REAL p_sink = sink_of(piece, k, &lp), q_sink = sink_of(piece, next, &lq);
        const REAL2 step = q - p, po = p - o, qo = q - o;
        const REAL cosine = 1 + dot(p, q), turn = difference_of_products(p.s0, q.s1, p.s1, q.s0);
        const REAL volume = difference_of_products(po.s0, qo.s1, po.s1, qo.s0);
        const REAL cosines = lp * lq * o_length + (1 + dot(o, p)) * lq + cosine * o_length + (1 + dot(q, o)) * lp;
        sum += 2 * atan2(volume, cosines);
        const REAL both = 1 / (lp * lq), sine2 = (dot(step, step) + turn * turn) * both * both, sine = sqrt(sine2);
        const REAL excess =
            sine2 <= SHORT_REACH2 && cosine > 0 ? ASIN_SERIES(REAL, sine2) : atan2(sine, cosine * both) / sine - 1;
        const REAL2 v = p / lp, w = q / lq;
        one += difference_of_products(v.s1, q_sink, p_sink, w.s1) - excess * step.s1 * both;
        other += difference_of_products(p_sink, w.s0, v.s0, q_sink) + excess * step.s0 * both;
        radial += difference_of_products(v.s0, w.s1, v.s1, w.s0) + excess * turn * both;
    }
    if (!(sum > 0)) {
        *centroid = 0;
        return 0;
    }
    const REAL scale = 1 / (2 * sum);
    *centroid = one * scale * chart->one + other * scale * chart->other + (radial * scale - 1) * chart->at;
    return sum;
}

/* The farthest point from the origin is a corner. */
inline void bound_piece(private const piece_t *piece, const chart_t *chart, private REAL4 *lower, private REAL4 *upper)
{
    REAL reach2 = 0;
    for (int k = 0; k < piece->n; ++k) {
        REAL length;
        reach2 = fmax(reach2, -2 * sink_of(piece, k, &length));
    }
    *lower = chart->at - sqrt(reach2);
    *upper = chart->at + sqrt(reach2);
}
#else
/* Sum over triangles that share corner 0, so that small pieces far from the origin keep their accuracy. */
inline REAL measure_piece(private const piece_t *piece, const chart_t *chart, private REAL4 *centroid)
{
    const REAL4 o = corner_of(piece, 0);
    REAL sum = 0;
    REAL4 first = 0;
    for (int k = 2; k < piece->n; ++k) {
        const REAL4 a = corner_of(piece, k - 1) - o, b = corner_of(piece, k) - o;
        const REAL turn = difference_of_products(a.s0, b.s1, a.s1, b.s0);
        sum += turn;
        first += turn * (a + b);
    }
    *centroid = sum > 0 ? o + first / (3 * sum) : o;
    return sum > 0 ? sum / 2 : 0;
}
#endif

#else

typedef cell_t piece_t;

#define EACH_FACE(piece, f)                                                                                            \
    int f = next_face(piece, 0);                                                                                       \
    f < FACE_CAPACITY;                                                                                                 \
    f = next_face(piece, f + 1)

inline REAL4 corner_of(private const piece_t *piece, int k)
{
    return (REAL4)(((private const REAL *)piece->x)[k], ((private const REAL *)piece->y)[k],
                   ((private const REAL *)piece->z)[k], 0);
}

inline int build_piece(private piece_t *piece, const chart_t *chart, int i, const pieces_t *mesh, REAL4 box_lower,
                       REAL4 box_upper)
{
    start_polyhedron(piece, chart->at, box_lower, box_upper);
    const int what = clip_polyhedron_by_row(piece, i, chart->at, mesh->starts, mesh->items, mesh->points);
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
}

/* The points nearer to the origin of piece j, moved by `shift`, than to point k of its row. */
inline REAL4 half_space(const chart_t *chart, REAL reach, const pieces_t *mesh, int j, int k, REAL4 shift,
                        private REAL *level)
{
    const int q = mesh->items[k];
    const REAL4 own = load_vector(mesh->origins, j), there = load_vector(mesh->points, q);
    const REAL4 low = j > q ? there : own, high = j > q ? own : there;
    const REAL4 a = low + shift - chart->at, b = high + shift - chart->at;
    const REAL4 normal = high - low;
    *level = dot_vectors(normal, a + b) / 2;
    return side_of_plane(normal, level, j > q, length_bound(normal), reach, a, b);
}

/* How many vertices of a shape are beyond a half-space. */
inline int count_beyond(private const shape_t *shape, REAL4 normal, REAL level)
{
    int beyond = 0;
    for (int v = 0; v < shape->n; ++v)
        beyond += shape->x[v] * normal.s0 + shape->y[v] * normal.s1 + shape->z[v] * normal.s2 - level > normal.s3;
    return beyond;
}

/* Unlike `clip_polyhedron` this takes any plane. New vertices are interpolated along edges, which is accurate since no
   edge is longer than the cell. */
inline int cut_piece(private piece_t *piece, REAL4 normal, REAL level)
{
  private
    const REAL *x = X(piece), *y = Y(piece), *z = Z(piece);
  private
    REAL *s = (private REAL *)piece->beyond;
    const REAL depth = normal.s3;
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
    const int face = replace_faces(piece, 0);
    if (face == FACE_CAPACITY)
        return PIECE_FULL;
    cut_edges(piece);
    close_rim(piece, face);
    return PIECE_CUT;
}

/* Sum over tetrahedra that share vertex 0, so that small pieces far from the origin keep their accuracy. */
inline REAL measure_piece(private piece_t *piece, const chart_t *chart, private REAL4 *centroid)
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

#ifndef SPHERE
inline void bound_piece(private const piece_t *piece, const chart_t *chart, private REAL4 *lower, private REAL4 *upper)
{
    *lower = REAL_MAX;
    *upper = -REAL_MAX;
    for (int k = 0; k < piece->n; ++k) {
        *lower = fmin(*lower, corner_of(piece, k));
        *upper = fmax(*upper, corner_of(piece, k));
    }
    *lower += chart->at;
    *upper += chart->at;
}
#endif
