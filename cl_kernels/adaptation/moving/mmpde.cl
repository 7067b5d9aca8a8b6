/* Moving mesh equations: steepest descent of Huang's functional on the simplices of a fixed triangulation.

       I = sum_K |K| h_K^(d(p - 1)) (theta |J|_F^(dp) + (1 - 2 theta) d^(dp/2) det(J)^p),   p = 3/2, theta = 1/3

   for the metric h^-2 I (W. Huang and L. Kamenski, J. Comput. Phys. 301, 2015). J = E0 E^-1 maps the simplex K onto
   that of the lattice: the columns of E and E0 are the edges from one vertex. log h_K is the mean over the vertices.
   With the gradients a_j of the linear shape functions, the rows of E^-1,

       dI/dx_j = sum_K W_K ((G1 + G2 - p G2) a_j - p d G1 J^T J a_j / |J|^2 + (G1 + G2) d (p - 1) / (d + 1) grad log h)

   with G1 and G2 the two terms, and W = |K| h_K^(d(p - 1)). Vertices are generators and their mirror images at the
   walls, so generators slide along walls. */
#include "geometry/domain.h"

/* Gradients of the shape functions, a[k] . e[l] = 1 if k = l else 0, of the simplex with edges e[k]; returns its
   determinant. */
inline REAL shape_gradients(const REAL e[DIM][DIM], REAL a[DIM][DIM])
{
#if DIM == 2
    const REAL det = e[0][0] * e[1][1] - e[0][1] * e[1][0];
    a[0][0] = e[1][1] / det;
    a[0][1] = -e[1][0] / det;
    a[1][0] = -e[0][1] / det;
    a[1][1] = e[0][0] / det;
#else
    for (int k = 0; k < DIM; ++k) {
        const int l = (k + 1) % DIM, m = (k + 2) % DIM;
        a[k][0] = e[l][1] * e[m][2] - e[l][2] * e[m][1];
        a[k][1] = e[l][2] * e[m][0] - e[l][0] * e[m][2];
        a[k][2] = e[l][0] * e[m][1] - e[l][1] * e[m][0];
    }
    const REAL det = e[0][0] * a[0][0] + e[0][1] * a[0][1] + e[0][2] * a[0][2];
    for (int k = 0; k < DIM; ++k)
        EACH_AXIS (c)
            a[k][c] /= det;
#endif
    return det;
}

/* x = generator j, or image j - n of the images: its owner, mirrored at the walls of its code. */
inline void place_vertex(global const REAL *points, const int n, const int j, global const int *owners,
                         global const int *codes, const REAL *lower, const REAL *upper, REAL *x)
{
    const int image = j >= n, owner = image ? owners[j - n] : j, code = image ? codes[j - n] : 0;
    EACH_AXIS (c) {
        const int wall = code >> 2 * c & 3;
        x[c] = points[DIM * owner + c];
        if (wall)
            x[c] = 2 * (wall == 1 ? lower[c] : upper[c]) - x[c];
    }
}

/* One generator: descent = -rate dI/dx / D, with D = sum_K W p (G1 + p G2) |a|^2, an estimate of the second derivative.
   energy = its share of I, power = dI/dx . velocity, flat = 1 if a simplex has no volume, else 0. room = the least
   height of the simplices.

   Row i of `vertices` holds the other d vertices of each simplex of generator i. */
kernel void descend_functional(const int size, global const int *starts, global const int *vertices,
                               global const int *owners, global const int *codes, global const REAL *reference,
                               global const REAL *points, global const REAL *h, global const REAL *gradient,
                               global const REAL *velocity, const REAL rate, DOMAIN_ARGS, global REAL *descent,
                               global REAL *energy, global REAL *power, global REAL *flat, global REAL *room)
{
    WORK_ITEM(i);
    BOX_CORNERS(lower, upper);
    const REAL p = R(1.5), theta = R(1) / 3;
    REAL force[DIM], steepest = 0, stiffness = 0, share = 0, folded = 0;
    EACH_AXIS (c)
        force[c] = 0;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        REAL e[DIM][DIM], e0[DIM][DIM], a[DIM][DIM], sizes = h[i];
        for (int v = 0; v < DIM; ++v) {
            const int j = vertices[DIM * k + v];
            REAL x[DIM], x0[DIM];
            place_vertex(points, size, j, owners, codes, lower, upper, x);
            place_vertex(reference, size, j, owners, codes, lower, upper, x0);
            EACH_AXIS (c) {
                e[v][c] = x[c] - points[DIM * i + c];
                e0[v][c] = x0[c] - reference[DIM * i + c];
            }
            sizes *= h[j >= size ? owners[j - size] : j];
        }
        const REAL det0 = shape_gradients(e0, a), det = shape_gradients(e, a);
        if (!(det0 * det > 0)) {
            folded = 1;
            continue;
        }
        /* a0 = the gradient at this generator, J = sum_v e0_v a_v^T, and J^T J a0. */
        REAL a0[DIM], jacobian[DIM][DIM], image[DIM], mapped[DIM], length2 = 0, norm2 = 0;
        EACH_AXIS (c) {
            a0[c] = 0;
            EACH_AXIS (b)
                jacobian[c][b] = 0;
        }
        for (int v = 0; v < DIM; ++v) {
            REAL own2 = 0;
            EACH_AXIS (c) {
                a0[c] -= a[v][c];
                own2 += a[v][c] * a[v][c];
                EACH_AXIS (b)
                    jacobian[c][b] += e0[v][c] * a[v][b];
            }
            steepest = fmax(steepest, own2);
        }
        EACH_AXIS (c) {
            image[c] = 0;
            length2 += a0[c] * a0[c];
            EACH_AXIS (b) {
                image[c] += jacobian[c][b] * a0[b];
                norm2 += jacobian[c][b] * jacobian[c][b];
            }
        }
        steepest = fmax(steepest, length2);
        EACH_AXIS (b) {
            mapped[b] = 0;
            EACH_AXIS (c)
                mapped[b] += jacobian[c][b] * image[c];
        }
        const REAL ratio = det0 / det;
#if DIM == 2
        const REAL g1 = theta * norm2 * sqrt(norm2), scale = 2 * sqrt(R(2)), size_factor = cbrt(sizes);
#else
        const REAL g1 = theta * norm2 * norm2 * sqrt(sqrt(norm2)), scale = 9 * sqrt(sqrt(R(3))),
                   size_factor = sqrt(sqrt(sizes * sqrt(sizes)));
#endif
        const REAL g2 = (1 - 2 * theta) * scale * ratio * sqrt(ratio);
        const REAL weight = fabs(det) / (DIM == 2 ? 2 : 6) * size_factor;
        EACH_AXIS (c)
            force[c] += weight * ((g1 + g2 - p * g2) * a0[c] - p * DIM * g1 / norm2 * mapped[c] +
                                  (g1 + g2) * DIM * (p - 1) / (DIM + 1) * gradient[DIM * i + c]);
        share += weight * (g1 + g2) / (DIM + 1);
        stiffness += weight * p * (g1 + p * g2) * length2;
    }
    REAL work = 0;
    EACH_AXIS (c) {
        descent[DIM * i + c] = stiffness > 0 ? -rate * force[c] / stiffness : 0;
        work += force[c] * velocity[DIM * i + c];
    }
    energy[i] = share;
    power[i] = work;
    flat[i] = folded;
    room[i] = steepest > 0 ? 1 / sqrt(steepest) : 0;
}

/* One generator: displacement + share velocity, at most k min(L, h) and `part` of the room long. */
kernel void bound_displacement(const int size, global const REAL *velocity, const REAL share, const REAL k,
                               const REAL part, global const REAL *local_length, global const REAL *room,
                               global REAL *displacement)
{
    WORK_ITEM(i);
    REAL d[DIM], length2 = 0;
    EACH_AXIS (c) {
        d[c] = displacement[DIM * i + c] + share * velocity[DIM * i + c];
        length2 += d[c] * d[c];
    }
    const REAL longest = fmin(k * local_length[i], part * room[i]);
    const REAL scale = length2 > longest * longest ? longest / sqrt(length2) : 1;
    EACH_AXIS (c)
        displacement[DIM * i + c] = scale * d[c];
}
