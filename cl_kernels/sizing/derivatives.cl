/* Gradients and Hessians of cell data on the neighbor graph, by weighted least squares. One work-item per cell.

   u(c_i + v) = u_i + g . v + v . H v / 2 is fitted to the means u_j of the neighbors and of their neighbors. A path to
   a cell has the weight 1 / |v|^4 if it crosses one face, SECOND_RING / |v|^4 if it crosses two: a cell that several
   paths reach counts several times. The second ring decides little, so that a layer of few cells is not smeared, but
   enough where a cell has few neighbors. The fit is exact for quadratic functions, at walls too. On a sphere v is the
   arc from c_i, in the plane that touches the sphere there. */
#include "opencl/real.h"

#define TERMS (CELL_DIM + CELL_DIM * (CELL_DIM + 1) / 2)
#define SECOND_RING R(0.03)
#define PACKED(row, column) ((row) * ((row) + 1) / 2 + (column))
#ifndef SMALLEST_PIVOT
#error "build with -DSMALLEST_PIVOT=share of a pivot that counts as zero"
#endif

/* Two directions in the plane of a cell; the axes themselves in a flat space. normal: of the sphere, or nothing. */
inline void choose_basis(global const REAL *normal, REAL *basis)
{
#ifdef SPHERE
    REAL3 n = (REAL3)(normal[0], normal[1], normal[2]);
    n /= sqrt(dot(n, n));
    const REAL3 size = fabs(n);
    REAL3 axis = (REAL3)(0, 0, 1);
    if (size.x <= size.y && size.x <= size.z)
        axis = (REAL3)(1, 0, 0);
    else if (size.y <= size.z)
        axis = (REAL3)(0, 1, 0);
    REAL3 first = axis - dot(axis, n) * n;
    first /= sqrt(dot(first, first));
    vstore3(first, 0, basis);
    vstore3(cross(n, first), 1, basis);
#else
    for (int a = 0; a < CELL_DIM * DIM; ++a)
        basis[a] = a / DIM == a % DIM;
#endif
}

/* The terms of the polynomial at v: its components, half the squares and the products, over `unit`. Returns the weight,
   0 for v = 0. */
inline REAL find_terms(const REAL *v, const REAL *basis, REAL unit, REAL radius, REAL *terms)
{
    REAL length2 = 0;
    for (int a = 0; a < CELL_DIM; ++a) {
        terms[a] = 0;
        for (int b = 0; b < DIM; ++b)
            terms[a] += basis[a * DIM + b] * v[b] * unit;
        length2 += terms[a] * terms[a];
    }
    if (length2 < R(1e-8))
        return 0;
#ifdef SPHERE
    const REAL sine = fmin(sqrt(length2) / (unit * radius), R(1)), stretch = asin(sine) / sine;
    for (int a = 0; a < CELL_DIM; ++a)
        terms[a] *= stretch;
#endif
    int t = CELL_DIM;
    for (int a = 0; a < CELL_DIM; ++a)
        for (int b = 0; b <= a; ++b)
            terms[t++] = terms[a] * terms[b] * (a == b ? R(0.5) : R(1));
    return 1 / (length2 * length2);
}

/* Add w terms terms^T to the packed lower triangle of `normal`. */
inline void add_to_matrix(REAL weight, const REAL *terms, REAL *normal)
{
    for (int r = 0; r < TERMS; ++r)
        for (int c = 0; c <= r; ++c)
            normal[PACKED(r, c)] += weight * terms[r] * terms[c];
}

/* Factorize the packed matrix as L D L^T in place. A pivot that is small against the diagonal leaves its unknown at
   0: with too few neighbors there is no Hessian, or only a part. Diagonal entries become 1 / D. */
inline void factorize(REAL *matrix)
{
    REAL pivots[TERMS];
    for (int r = 0; r < TERMS; ++r) {
        for (int c = 0; c <= r; ++c) {
            REAL sum = matrix[PACKED(r, c)];
            for (int m = 0; m < c; ++m)
                sum -= matrix[PACKED(r, m)] * pivots[m] * matrix[PACKED(c, m)];
            if (c < r) {
                matrix[PACKED(r, c)] = sum * matrix[PACKED(c, c)];
            } else {
                const bool small = sum <= R(SMALLEST_PIVOT) * matrix[PACKED(r, r)];
                pivots[r] = small ? 0 : sum;
                matrix[PACKED(r, r)] = small ? 0 : 1 / sum;
            }
        }
    }
}

/* Solve with the factors; the solution replaces the right-hand side. */
inline void substitute(const REAL *factors, REAL *x)
{
    for (int r = 0; r < TERMS; ++r)
        for (int c = 0; c < r; ++c)
            x[r] -= factors[PACKED(r, c)] * x[c];
    for (int r = TERMS - 1; r >= 0; --r) {
        x[r] *= factors[PACKED(r, r)];
        for (int c = r + 1; c < TERMS; ++c)
            x[r] -= factors[PACKED(c, r)] * x[c];
    }
}

/* starts, neighbors: rows of the graph, without walls. across (m, DIM): vectors between the centroids. normals
   (n, DIM): positions on the sphere, else not read. values (n, width). gradients (n, width, DIM), hessians (n, width,
   DIM, DIM): in the axes of space. */
kernel void fit_quadratics(const int size, global const int *starts, global const int *neighbors,
                           global const REAL *across, global const REAL *normals, const int width,
                           global const REAL *values, global REAL *gradients, global REAL *hessians)
{
    WORK_ITEM(i);
    REAL basis[CELL_DIM * DIM], terms[TERMS], matrix[TERMS * (TERMS + 1) / 2], radius = 1, reach2 = 0;
    const int begin = starts[i], end = starts[i + 1];
    choose_basis(normals + i * DIM, basis);
#ifdef SPHERE
    radius = sqrt(normals[i * DIM] * normals[i * DIM] + normals[i * DIM + 1] * normals[i * DIM + 1] +
                  normals[i * DIM + 2] * normals[i * DIM + 2]);
#endif
    for (int k = begin; k < end; ++k) {
        REAL length2 = 0;
        for (int a = 0; a < DIM; ++a)
            length2 += across[k * DIM + a] * across[k * DIM + a];
        reach2 = fmax(reach2, length2);
    }
    const REAL unit = reach2 > 0 ? 1 / sqrt(reach2) : 0;
    for (int t = 0; t < TERMS * (TERMS + 1) / 2; ++t)
        matrix[t] = 0;
    for (int column = -1; column < width; ++column) {
        /* The matrix first, then one right-hand side after the other. */
        REAL x[TERMS];
        const REAL here = column < 0 ? 0 : values[i * width + column];
        for (int t = 0; t < TERMS; ++t)
            x[t] = 0;
        for (int k = begin; k < end; ++k) {
            const int j = neighbors[k];
            /* The neighbor itself, and its neighbors. */
            for (int l = starts[j] - 1; l < starts[j + 1]; ++l) {
                const bool first = l < starts[j];
                REAL v[DIM];
                for (int a = 0; a < DIM; ++a)
                    v[a] = across[k * DIM + a] + (first ? 0 : across[l * DIM + a]);
                const REAL weight = find_terms(v, basis, unit, radius, terms) * (first ? R(1) : SECOND_RING);
                if (column < 0) {
                    add_to_matrix(weight, terms, matrix);
                } else {
                    const REAL rise = weight * (values[(first ? j : neighbors[l]) * width + column] - here);
                    for (int t = 0; t < TERMS; ++t)
                        x[t] += terms[t] * rise;
                }
            }
        }
        if (column < 0) {
            factorize(matrix);
            continue;
        }
        substitute(matrix, x);
        global REAL *gradient = gradients + (i * width + column) * DIM;
        global REAL *hessian = hessians + (i * width + column) * DIM * DIM;
        for (int a = 0; a < DIM; ++a) {
            gradient[a] = 0;
            for (int p = 0; p < CELL_DIM; ++p)
                gradient[a] += basis[p * DIM + a] * x[p] * unit;
            for (int b = 0; b < DIM; ++b) {
                REAL sum = 0;
                for (int p = 0; p < CELL_DIM; ++p)
                    for (int q = 0; q < CELL_DIM; ++q) {
                        const int row = max(p, q), col = min(p, q);
                        sum += basis[p * DIM + a] * basis[q * DIM + b] * x[CELL_DIM + PACKED(row, col)];
                    }
                hessian[a * DIM + b] = sum * unit * unit;
            }
        }
    }
}
