/* The checks of `check_row` for the rows of eight generators at a time, one per vector lane. `check_row` itself handles
   cells with walls, and rows that may be inconsistent with those of neighbors. */
#include "simd/cell_corners.h"

#if ROW_CAPACITY < CHECKED_FACES
#error "there is no room for the corners of cells that are checked"
#endif

/* Whether the neighbors of generator i list it between the right two. */
inline bool fits_exactly(int i, global const int *row, int n, global const int *starts, global const int *neighbors)
{
    bool fit = true;
    for (int k = 0; k < n && fit; ++k) {
        const int other = starts[row[k]], m = starts[row[k] + 1] - other;
        fit = stands_between(i, row[k == n - 1 ? 0 : k + 1], row[k == 0 ? n - 1 : k - 1], neighbors + other, m);
    }
    return fit;
}

/* Check the rows of LANES generators from number `first` on; see `check_rows`. Returns the number of wrong rows. */
inline int check_eight(int first, int size, global const int *starts, global const int *neighbors,
                       global const double *points, const double *lower, const double *upper, global int *fits,
                       global int *marks)
{
    ROWS_BEHIND(behind, CHECKED_FACES + 1);
    long counts[LANES], bits[LANES], turned[LANES], close[LANES];
    bool walled[LANES];
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const int i = min(first + lane, size - 1), n = starts[i + 1] - starts[i];
        counts[lane] = n <= CHECKED_FACES ? n : 0;
        most = max(most, (int)counts[lane]);
    }
    /* All rows are read up to the length of the longest, as branches on different lengths would be mispredicted. Behind
       its last face a row repeats its first. */
    for (int lane = 0; lane < LANES; ++lane) {
        const int i = min(first + lane, size - 1), n = counts[lane];
        global const int *row = neighbors + (n > 0 ? starts[i] : 0);
        int least = INT_MAX;
        for (int k = 0; k <= most; ++k) {
            const int face = row[k < n ? k : 0];
            least = min(least, face);
            put_behind(behind, k, lane, max(face, 0), points);
        }
        walled[lane] = least < 0;
    }
    outlines_t corners;
    eight_t sites = load_sites(first, size, points);
    project_rows(behind, most, &sites);
    const double8 x = origin_x(&sites), y = origin_y(&sites);
    find_corners(&corners, behind, most, x, y);

    const long8 ends = vload8(0, counts), last = max(ends - 1, (long8)(0));
    double8 ux = pick(corners.x, last), uy = pick(corners.y, last), dx, dy;
    load_row(behind, 0, &dx, &dy);
    dx -= x;
    dy -= y;
    double8 reach2 = 0, least2 = DBL_MAX;
    /* Bits per face: where the row is not convex, and where it turns back. */
    long8 bad = 0, turns = 0;
    for (int k = 0; k < most; ++k) {
        double8 after_x, after_y;
        load_row(behind, k + 1, &after_x, &after_y);
        after_x -= x;
        after_y -= y;
        const double8 vx = corners.x[k], vy = corners.y[k], ex = vx - ux, ey = vy - uy;
        const double8 d2 = dx * dx + dy * dy;
        const long8 here = k < ends;
        const long8 good =
            (dx * after_y - dy * after_x > 0) & (dx * ey - dy * ex > 0) & (ex * ex + ey * ey >= DBL_EPSILON * d2);
        bad = here ? (good ? bad : bad | (1L << k)) : bad;
        turns = (here & (dy < 0) & (after_y >= 0)) ? turns | (1L << k) : turns;
        reach2 = here ? max(reach2, vx * vx + vy * vy) : reach2;
        least2 = here ? min(least2, d2) : least2;
        ux = vx;
        uy = vy;
        dx = after_x;
        dy = after_y;
    }
    vstore8(bad, 0, bits);
    vstore8(turns, 0, turned);
    vstore8(least2 < sqrt(DBL_EPSILON) * reach2, 0, close);
    const int given = min(size - first, LANES);
    int found = 0;
    for (int lane = 0; lane < given; ++lane) {
        const int i = first + lane, n = counts[lane];
        global const int *row = neighbors + starts[i];
        const bool fit = n > 0 && !walled[lane] && (fits[i] || fits_exactly(i, row, n, starts, neighbors));
        if (!fit) {
            found += check_row(i, starts, neighbors, points, lower, upper, fits, marks);
            continue;
        }
        fits[i] = 1;
        if (bits[lane] == 0 && popcount(turned[lane]) == 1 && !close[lane])
            continue;
        ++found;
        atomic_or(marks + i, 1);
        for (int k = 0; k < n; ++k)
            if ((bits[lane] >> k) & 1) {
                atomic_or(marks + row[k == 0 ? n - 1 : k - 1], 1);
                atomic_or(marks + row[k], 1);
                atomic_or(marks + row[k == n - 1 ? 0 : k + 1], 1);
            }
    }
    return found;
}
