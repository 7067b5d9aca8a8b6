/* Motion of generators. One work-item per generator. */
#include "geometry/domain.h"

/* u = -grad phi, the paper's (3.3). The solver's potential is psi = -phi, from -div grad psi = e:

       u = grad psi = 1 / V_i sum_j l_ij / d_ij (psi_j - psi_i) (m_ij - x_i)

   It is exact for linear psi in a cell without walls; walls have no flux. */
kernel void compute_potential_gradient(const int size, global const int *starts, global const int *neighbors,
                                       global const FACE *face_measures, global const FACE *face_centroids,
                                       global const REAL *volumes, global const REAL *points, global const REAL *psi,
                                       global REAL *u PERIOD_ARGS)
{
    WORK_ITEM(i);
    REAL sum[DIM] = {0};
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbors[k];
        if (j < 0)
            continue;
        REAL d2 = 0;
        EACH_AXIS (a) {
            const REAL d = DIFFERENCE(a, points[DIM * i + a], points[DIM * j + a]);
            d2 += d * d;
        }
        const REAL flux = face_measures[k] / sqrt(d2) * (psi[j] - psi[i]);
        EACH_AXIS (a)
            sum[a] += flux * face_centroids[DIM * k + a];
    }
    EACH_AXIS (a)
        u[DIM * i + a] = sum[a] / volumes[i];
}

/* u = alpha u with alpha = min(limit, k / max_i(|u_i| / h_i)), the paper's (3.5). summaries[4 slot + 3] is the maximum.
 */
kernel void relax_correction(const int size, global const REAL *summaries, const int slot, const REAL limit,
                             const REAL k, global REAL *u)
{
    WORK_ITEM(i);
    const REAL fastest = summaries[4 * slot + 3];
    const REAL alpha = fastest * limit > k ? k / fastest : limit;
    EACH_AXIS (a)
        u[DIM * i + a] *= alpha;
}

/* x += a lloyd + b correction, the paper's (3.4), clipped to clip h_i (clip = 0: not clipped), and kept in the domain.
   velocity = the displacement after that. */
kernel void move_generators(const int size, global const REAL *lloyd, const REAL a, global const REAL *correction,
                            const REAL b, global const REAL *h, const REAL clip, DOMAIN_ARGS, global REAL *points,
                            global REAL *velocity)
{
    WORK_ITEM(i);
    REAL d[DIM], x[DIM], y[DIM];
    REAL d2 = 0;
    EACH_AXIS (c) {
        d[c] = a * lloyd[DIM * i + c] + b * correction[DIM * i + c];
        d2 += d[c] * d[c];
    }
    const REAL longest = clip * h[i];
    const REAL scale = clip > 0 && d2 > longest * longest ? longest / sqrt(d2) : 1;
    EACH_AXIS (c) {
        x[c] = points[DIM * i + c];
        y[c] = x[c] + scale * d[c];
    }
    /* Fixed generators may be outside of the part of the domain in which the others move. */
    if (d2 > 0)
        reflect_inside(x, y, DOMAIN);
    EACH_AXIS (c) {
        points[DIM * i + c] = y[c];
        velocity[DIM * i + c] = DIFFERENCE(c, x[c], y[c]);
    }
}

/* Moves generators out of the balls of fixed ones, to the nearest point of the sphere; `passes` times, as balls
   overlap. Generators with labels first, first + 1, ... have the balls ball_starts[0] ... ball_starts[1] - 1, and so
   on; a ball has DIM coordinates and a radius. Whoever is in a ball is a neighbor of one of its generators. */
kernel void leave_balls(const int size, global const int *starts, global const int *neighbors, global const int *labels,
                        const int fixed, const int first, const int count, global const int *ball_starts,
                        global const REAL *balls, const int passes, DOMAIN_ARGS, global REAL *points,
                        global REAL *velocity)
{
    WORK_ITEM(i);
    if (labels[i] < fixed)
        return;
    REAL x[DIM], y[DIM];
    bool moved = false;
    EACH_AXIS (a)
        y[a] = x[a] = points[DIM * i + a];
    for (int pass = 0; pass < passes; ++pass)
        for (int k = starts[i]; k < starts[i + 1]; ++k) {
            const int g = neighbors[k] < 0 ? -1 : labels[neighbors[k]] - first;
            if (g < 0 || g >= count)
                continue;
            for (int b = ball_starts[g]; b < ball_starts[g + 1]; ++b) {
                global const REAL *ball = balls + (DIM + 1) * b;
                REAL d[DIM], d2 = 0;
                EACH_AXIS (a) {
                    d[a] = DIFFERENCE(a, ball[a], y[a]);
                    d2 += d[a] * d[a];
                }
                if (d2 >= ball[DIM] * ball[DIM] || d2 == 0)
                    continue;
                const REAL out = ball[DIM] / sqrt(d2) - 1;
                EACH_AXIS (a)
                    y[a] += out * d[a];
                moved = true;
            }
        }
    if (!moved)
        return;
    reflect_inside(x, y, DOMAIN);
    EACH_AXIS (a) {
        points[DIM * i + a] = y[a];
        velocity[DIM * i + a] += DIFFERENCE(a, x[a], y[a]);
    }
}

/* displacement = 0 for fixed generators, labels[i] < fixed. */
kernel void zero_fixed_displacements(const int size, global const int *labels, const int fixed,
                                     global REAL *displacement)
{
    WORK_ITEM(i);
    if (labels[i] < fixed)
        EACH_AXIS (a)
            displacement[DIM * i + a] = 0;
}

/* lloyd = factor lloyd + share velocity. */
kernel void add_momentum(const int size, const REAL factor, global const REAL *velocity, const REAL share,
                         global REAL *lloyd)
{
    WORK_ITEM(i);
    EACH_AXIS (a)
        lloyd[DIM * i + a] = factor * lloyd[DIM * i + a] + share * velocity[DIM * i + a];
}
