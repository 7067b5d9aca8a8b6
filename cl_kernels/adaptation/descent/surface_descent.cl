/* Gradient of the cell quality with respect to the generators, in 3D. From Q = 36 pi V^2 / S^3, up to a constant,

     E = sum_c omega_c (3 log S_c - 2 log V_c),

   with omega = 1 - bad_cell_weight log Q, larger for bad cells. A cell pulls the edges of its faces into them with the
   tension 3 omega / S, and pushes its faces outwards with the pressure 2 omega / V.

   A point p of the edge between the cells i, a, b moves by s (p - x_i).dx_i, with s in the plane of x_i, x_a, x_b, and
   s.(x_a - x_i) = s.(x_b - x_i) = 1; on a wall it moves along the wall. The area of a face grows by the motion of its
   edges in its plane. Thus, with the sum K of s . (tension times outward direction) over the three faces at an edge,

     dE/dx_i = sum over edges of K integral (p - x_i) dl + sum over faces of A / |d| (P_j - P_i) (m - x_i). */
#include "geometry/domain.h"
#include "tessellation/own_planes.h"
#include "tessellation/row_counts.h"
#include "tessellation/wide_vectors.h"

/* forces[i] = (3 omega / S, 2 omega / V). One work-item per generator. */
kernel void compute_surface_forces(const int size, global const int *starts, global const FACE *face_measures,
                                   global const REAL *volumes, global const REAL *quality, const REAL bad_cell_weight,
                                   global REAL2 *forces)
{
    LONG_ITEM(i);
    REAL surface = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k)
        surface += face_measures[k];
    const REAL omega = 1 - bad_cell_weight * log(fmax(quality[i], R(1e-6)));
    forces[i] = (REAL2)(3 * omega / surface, 2 * omega / volumes[i]);
}

/* The faces of a cell: the plane of each is y . away = level. `away` is the vector to the neighbor, or the outward
   normal of a wall. `inverse` is 1 / |away|, and 0 for a wall; `tension` is that of the neighbor, and 0 for a wall. */
typedef struct {
    REAL4 away[MOST_FACES]; /* and its square */
    REAL level[MOST_FACES], inverse[MOST_FACES], tension[MOST_FACES];
} sides_t;

/* The same for the faces in the lanes. */
typedef struct {
    places_t away;
    WIDE square, level, inverse, tension;
} side_t;

inline void gather_side(side_t *side, private const sides_t *sides, const int *k)
{
    gather_lanes(&side->away, &side->square, sides->away, k);
    side->level = GATHER_WIDE(sides->level, k);
    side->inverse = GATHER_WIDE(sides->inverse, k);
    side->tension = GATHER_WIDE(sides->tension, k);
}

/* Add `once` times K integral (p - x_i) dl of the edge between faces a and b up to its end v, which lies in the
   direction of c = a x b. The integral begins at the point of the line that is nearest to x_i: with t = c.v / |c|, it
   is t v - t^2 / 2 c / |c|. `own` is the tension of the cell. */
inline void add_pull(places_t *sum, const side_t *a, const side_t *b, const places_t *c, REAL own, const places_t *v,
                     WIDE once)
{
    const WIDE ab = product_of(&a->away, &b->away), squares = a->square * b->square, d2 = squares - ab * ab;
    const WIDE tensions = a->tension + b->tension, inverses = a->inverse + b->inverse;
    const WIDE free = (own + a->tension) * (a->square - ab) * a->inverse +
                      (own + b->tension) * (b->square - ab) * b->inverse -
                      tensions * sqrt(fmax(a->square + b->square - 2 * ab, (WIDE)0));
    const WIDE at_wall = own - tensions - (own + tensions) * ab * inverses;
    const WIDE pull = ((a->inverse == 0) | (b->inverse == 0)) ? at_wall : free;
    /* The edge between two walls does not move, that of nearly parallel faces is short. */
    const WIDE over2 = ((d2 > R(1e-12) * squares) & (inverses > 0)) ? 1 / d2 : (WIDE)0;
    const WIDE along = product_of(c, v) * over2, share = once * pull * along;
    add_along(sum, share, v);
    add_along(sum, -share * along / 2, c);
}

/* The sum of K integral (p - x_i) dl over the edges of a cell with these vertices, as triples of faces. */
inline REAL4 pull_of_edges(private const sides_t *sides, global const uchar4 *corners, int count, REAL own)
{
    places_t sums[HALVES];
    for (int turn = 0; turn < HALVES; ++turn)
        sums[turn].x = sums[turn].y = sums[turn].z = 0;
    for (int block = 0; WIDTH * block < count; ++block) {
        const int first = WIDTH * block;
        places_t *sum = &sums[HALF_OF(block)];
        int at_a[WIDTH], at_b[WIDTH], at_c[WIDTH];
        REAL counted[WIDTH];
        for (int lane = 0; lane < WIDTH; ++lane) {
            const uchar4 at = corners[min(first + lane, count - 1)];
            at_a[lane] = at.s0;
            at_b[lane] = at.s1;
            at_c[lane] = at.s2;
            counted[lane] = first + lane < count;
        }
        side_t a, b, c;
        gather_side(&a, sides, at_a);
        gather_side(&b, sides, at_b);
        gather_side(&c, sides, at_c);
        places_t ab, bc, ca, v = {0, 0, 0};
        cross_of(&ab, &a.away, &b.away);
        cross_of(&bc, &b.away, &c.away);
        cross_of(&ca, &c.away, &a.away);
        const WIDE over = 1 / product_of(&a.away, &bc), once = LOAD_WIDE(0, counted);
        add_along(&v, a.level * over, &bc);
        add_along(&v, b.level * over, &ca);
        add_along(&v, c.level * over, &ab);
        add_pull(sum, &a, &b, &ab, own, &v, once);
        add_pull(sum, &b, &c, &bc, own, &v, once);
        add_pull(sum, &c, &a, &ca, own, &v, once);
    }
    WIDE x[HALVES], y[HALVES], z[HALVES];
    for (int turn = 0; turn < HALVES; ++turn) {
        x[turn] = sums[turn].x;
        y[turn] = sums[turn].y;
        z[turn] = sums[turn].z;
    }
    return (REAL4)(sum_of_lanes(x), sum_of_lanes(y), sum_of_lanes(z), 0);
}

/* lloyd = -rate h^2 dE/dx_i, at most max_displacement h. One work-item per generator. A cell without known vertices
   keeps the displacement to its centroid; so does one at a wall whose plane moves with its generator. */
kernel void descend_surface(const int size, global const int *starts, global const int *neighbors,
                            global const FACE *face_measures, global const FACE *face_centroids,
                            global const uchar4 *corners, global const REAL *points, global const REAL *h,
                            global const REAL2 *forces, const REAL rate, const REAL max_displacement,
                            global REAL *lloyd PERIOD_ARGS)
{
    LONG_ITEM(i);
    const int begin = starts[i], faces = starts[i + 1] - begin;
    if (faces > MOST_FACES || corners[2 * begin].s3 == NO_CORNERS)
        return;
    sides_t sides;
    const REAL2 own = forces[i];
    REAL4 g = 0;
    for (int f = 0; f < faces; ++f) {
        const int k = begin + f, j = neighbors[k];
        const REAL4 m = (REAL4)(face_centroids[3 * k], face_centroids[3 * k + 1], face_centroids[3 * k + 2], 0);
        REAL4 away;
        if (j >= 0) {
            away = (REAL4)(DIFFERENCE(0, points[3 * i], points[3 * j]),
                           DIFFERENCE(1, points[3 * i + 1], points[3 * j + 1]),
                           DIFFERENCE(2, points[3 * i + 2], points[3 * j + 2]), 0);
            away.s3 = dot(away, away);
            sides.level[f] = away.s3 / 2;
            sides.inverse[f] = 1 / sqrt(away.s3);
            sides.tension[f] = forces[j].s0;
            g += face_measures[k] * sides.inverse[f] * (forces[j].s1 - own.s1) * m;
        } else if (WALLS_MOVE) {
            return;
        } else {
            const int wall = -1 - j;
            const REAL sign = wall % 2 ? 1 : -1;
            away = (REAL4)(wall < 2 ? sign : 0, wall / 2 == 1 ? sign : 0, wall > 3 ? sign : 0, 0);
            sides.level[f] = dot(away, m);
            away.s3 = 1;
            sides.inverse[f] = sides.tension[f] = 0;
        }
        sides.away[f] = away;
    }
    g += pull_of_edges(&sides, corners + 2 * begin, 2 * faces - 4, own.s0);
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
