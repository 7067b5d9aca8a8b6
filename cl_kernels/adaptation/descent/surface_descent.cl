/* Gradient of the cell quality with respect to the generators, in 3D. From Q = 36 pi V^2 / S^3, up to a constant,

     E = sum_c omega_c (3 log S_c - 2 log V_c),

   with omega = 1 - bad_cell_weight log Q, larger for bad cells. A cell pulls the edges of its faces into them with the
   tension 3 omega / S, and pushes its faces outwards with the pressure 2 omega / V.

   A point p of the edge between the cells i, a, b moves by s (p - x_i).dx_i, with s in the plane of x_i, x_a, x_b, and
   s.(x_a - x_i) = s.(x_b - x_i) = 1; on a wall it moves along the wall. The area of a face grows by the motion of its
   edges in its plane. Thus, with the sum K of s . (tension times outward direction) over the three faces at an edge,

     dE/dx_i = sum over edges of K integral (p - x_i) dl + sum over faces of A / |d| (P_j - P_i) (m - x_i). */
#include "geometry/domain.h"
#include "tessellation/row_counts.h"

/* forces[i] = (3 omega / S, 2 omega / V). One work-item per generator. */
kernel void compute_surface_forces(const int size, global const int *starts, global const FACE *face_measures,
                                   global const REAL *volumes, global const REAL *quality, const REAL bad_cell_weight,
                                   global REAL2 *forces)
{
    WORK_ITEM(i);
    REAL surface = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        surface += face_measures[k];
    const REAL omega = 1 - bad_cell_weight * log(fmax(quality[i], R(1e-6)));
    forces[i] = (REAL2)(3 * omega / surface, 2 * omega / volumes[i]);
}

/* A face of the cell: its plane is y . away = level. `away` is the vector to the neighbor, or the outward normal of a
   wall. `inverse` is 1 / |away|, and 0 for a wall; `tension` is that of the neighbor. */
typedef struct {
    REAL4 away;
    REAL square, level, inverse, tension;
} side_t;

/* K integral (p - x_i) dl of the edge between faces a and b up to its end v, which lies in the direction of a x b. The
   integral begins at the point of the line that is nearest to x_i. `own` is the tension of the cell. */
inline REAL4 pull_of_edge(const side_t *a, const side_t *b, REAL own, REAL4 v)
{
    const REAL ab = dot(a->away, b->away), d2 = a->square * b->square - ab * ab;
    const bool wall_a = a->inverse == 0, wall_b = b->inverse == 0;
    /* The edge between two walls does not move, that of nearly parallel faces is short. */
    if (!(d2 > R(1e-12) * a->square * b->square) || (wall_a && wall_b))
        return 0;
    const REAL over = 1 / sqrt(d2);
    REAL pull;
    if (wall_a || wall_b) {
        const side_t *f = wall_a ? b : a;
        pull = own - f->tension - (own + f->tension) * ab * f->inverse;
    } else {
        pull = (own + a->tension) * (a->square - ab) * a->inverse + (own + b->tension) * (b->square - ab) * b->inverse -
               (a->tension + b->tension) * sqrt(a->square + b->square - 2 * ab);
    }
    const REAL4 along = over * cross(a->away, b->away);
    const REAL t = dot(along, v);
    return pull * over * t * (v - t / 2 * along);
}

/* lloyd = -rate h^2 dE/dx_i, at most max_displacement h. One work-item per generator. A cell without known vertices
   keeps the displacement to its centroid. */
kernel void descend_surface(const int size, global const int *starts, global const int *neighbors,
                            global const FACE *face_measures, global const FACE *face_centroids,
                            global const uchar4 *corners, global const REAL *points, global const REAL *h,
                            global const REAL2 *forces, const REAL rate, const REAL max_displacement,
                            global REAL *lloyd PERIOD_ARGS)
{
    WORK_ITEM(i);
    const int begin = starts[i], faces = starts[i + 1] - begin;
    if (faces > MOST_FACES || corners[2 * begin].s3 == NO_CORNERS)
        return;
    side_t sides[MOST_FACES];
    const REAL2 own = forces[i];
    REAL4 g = 0;
    for (int f = 0; f < faces; ++f) {
        const int k = begin + f, j = neighbors[k];
        const REAL4 m = (REAL4)(face_centroids[3 * k], face_centroids[3 * k + 1], face_centroids[3 * k + 2], 0);
        side_t side;
        if (j >= 0) {
            side.away = (REAL4)(DIFFERENCE(0, points[3 * i], points[3 * j]),
                                DIFFERENCE(1, points[3 * i + 1], points[3 * j + 1]),
                                DIFFERENCE(2, points[3 * i + 2], points[3 * j + 2]), 0);
            side.square = dot(side.away, side.away);
            side.level = side.square / 2;
            side.inverse = 1 / sqrt(side.square);
            side.tension = forces[j].s0;
            g += face_measures[k] * side.inverse * (forces[j].s1 - own.s1) * m;
        } else {
            const int wall = -1 - j;
            const REAL sign = wall % 2 ? 1 : -1;
            side.away = (REAL4)(wall < 2 ? sign : 0, wall / 2 == 1 ? sign : 0, wall > 3 ? sign : 0, 0);
            side.square = 1;
            side.level = dot(side.away, m);
            side.inverse = side.tension = 0;
        }
        sides[f] = side;
    }
    for (int v = 0; v < 2 * faces - 4; ++v) {
        const uchar4 at = corners[2 * begin + v];
        const side_t *a = sides + at.s0, *b = sides + at.s1, *c = sides + at.s2;
        const REAL4 bc = cross(b->away, c->away);
        const REAL4 sum = a->level * bc + b->level * cross(c->away, a->away) + c->level * cross(a->away, b->away);
        const REAL4 y = sum / dot(a->away, bc);
        g += pull_of_edge(a, b, own.s0, y) + pull_of_edge(b, c, own.s0, y) + pull_of_edge(c, a, own.s0, y);
    }
    const REAL unit = h[i];
    REAL4 u = -rate * unit * unit * g;
    const REAL length = sqrt(dot(u, u));
    if (length > max_displacement * unit)
        u *= max_displacement * unit / length;
    /* A degenerate vertex has no gradient. */
    if (!(length < REAL_MAX))
        u = 0;
    lloyd[3 * i] = u.s0;
    lloyd[3 * i + 1] = u.s1;
    lloyd[3 * i + 2] = u.s2;
}
