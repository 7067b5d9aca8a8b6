#include "common/real.h"

/* The exact derivative of the cells' volumes by the generators,

     dV_i/dx_j = w_ij (x_j - m_ij),   dV_i/dx_i = sum_j w_ij (m_ij - x_i),   w_ij = l_ij / d_ij,

   as the operator J = d r / d x of the excess r_i = log V_i - d log h(x_i), and its transpose. m_ij is stored relative
   to x_i. A wall is fixed: its faces contribute nothing. */

inline REAL squared_distance(global const REAL *points, int i, int j)
{
    REAL d2 = 0;
    for (int a = 0; a < DIM; ++a) {
        const REAL d = points[DIM * j + a] - points[DIM * i + a];
        d2 += d * d;
    }
    return d2;
}

/* Per generator i: own[i] = dr_i/dx_i; for each face the derivatives across it, rows[k] = dr_i/dx_j and
   columns[k] = dr_j/dx_i, in single precision (the operator of an inexact Newton step: memory traffic is its cost, and 1e-7
   is far below what the step leaves); and the inverse of the diagonal of J W J^T + eps, W = h^2, which preconditions. */
kernel void assemble_derivative(const int size, global const int *starts, global const int *neighbours,
                                global const REAL *face_measures, global const REAL *face_centroids,
                                global const REAL *volumes, global const REAL *points, global const REAL *gradient,
                                global const REAL *h, global const REAL *eps, global float *rows,
                                global float *columns, global REAL *own, global REAL *inverse_diagonal)
{
    WORK_ITEM(i);
    REAL self[DIM];
    for (int a = 0; a < DIM; ++a)
        self[a] = 0;
    REAL diagonal = 0;
    const REAL volume = volumes[i];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        if (j < 0)
            continue;
        const REAL w = face_measures[k] / sqrt(squared_distance(points, i, j));
        REAL square = 0;
        for (int a = 0; a < DIM; ++a) {
            const REAL m = face_centroids[DIM * k + a];
            const REAL other = w * (points[DIM * j + a] - points[DIM * i + a] - m) / volume;
            square += other * other;
            self[a] += w * m;
            rows[DIM * k + a] = (float)other;
            columns[DIM * k + a] = (float)(-w * m / volumes[j]);
        }
        diagonal += square * h[j] * h[j];
    }
    REAL square = 0;
    for (int a = 0; a < DIM; ++a) {
        const REAL s = self[a] / volume - DIM * gradient[DIM * i + a];
        own[DIM * i + a] = s;
        square += s * s;
    }
    inverse_diagonal[i] = 1 / (diagonal + square * h[i] * h[i] + eps[i]);
}

/* Per generator i: u = W J^T y, u_i = h_i^2 (own_i y_i + sum_j dr_j/dx_i y_j). */
kernel void apply_transpose(const int size, global const int *starts, global const int *neighbours,
                            global const float *columns, global const REAL *own, global const REAL *h,
                            global const REAL *y, global REAL *u)
{
    WORK_ITEM(i);
    REAL sum[DIM];
    for (int a = 0; a < DIM; ++a)
        sum[a] = own[DIM * i + a] * y[i];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        if (j < 0)
            continue;
        const REAL yj = y[j];
        for (int a = 0; a < DIM; ++a)
            sum[a] += columns[DIM * k + a] * yj;
    }
    for (int a = 0; a < DIM; ++a)
        u[DIM * i + a] = h[i] * h[i] * sum[a];
}

/* Per generator i: out = J u + eps y. */
kernel void apply_derivative(const int size, global const int *starts, global const int *neighbours,
                             global const float *rows, global const REAL *own, global const REAL *u,
                             global const REAL *eps, global const REAL *y, global REAL *out)
{
    WORK_ITEM(i);
    REAL sum = eps[i] * y[i];
    for (int a = 0; a < DIM; ++a)
        sum += own[DIM * i + a] * u[DIM * i + a];
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        const int j = neighbours[k];
        if (j < 0)
            continue;
        for (int a = 0; a < DIM; ++a)
            sum += rows[DIM * k + a] * u[DIM * j + a];
    }
    out[i] = sum;
}

/* Per generator i: eps[i] = min(3, penalty (1 + max (q / lenience)^2)) / (1 + (r / bound)^2), q = -log Q of the cell and of
   its neighbours. Bad cells and those around them are let off their size a little, for they are what costs quality;
   cells that are far off give way less than those that are nearly right, which caps the largest error. A lenience or
   bound of 0 leaves its factor out. */
kernel void set_penalty(const int size, global const int *starts, global const int *neighbours,
                        global const REAL *quality, global const REAL *excess, const REAL penalty,
                        const REAL lenience, const REAL bound, global REAL *eps)
{
    WORK_ITEM(i);
    REAL e = penalty;
    if (lenience > 0) {
        REAL worst = quality[i];
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            if (neighbours[k] >= 0)
                worst = fmin(worst, quality[neighbours[k]]);
        const REAL q = log(fmax(worst, R(1e-6))) / lenience;
        e = fmin(e * (1 + q * q), fmax(R(3), penalty));
    }
    const REAL r = bound > 0 ? excess[i] / bound : 0;
    eps[i] = e / (1 + r * r);
}

/* Per generator i: what the projection takes from the displacement, correction = -W J^T y. */
kernel void negate(const int size, global REAL *u)
{
    WORK_ITEM(i);
    for (int a = 0; a < DIM; ++a)
        u[DIM * i + a] = -u[DIM * i + a];
}

/* Per generator i: b += r. */
kernel void add_excess(const int size, global const REAL *excess, global REAL *b)
{
    WORK_ITEM(i);
    b[i] += excess[i];
}
