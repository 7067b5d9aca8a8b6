/* Cells to rebuild in an incremental update, eight at a time, as hulls of a few candidates. */
#include "simd/cell_corners.h"
#include "simd/hull.h"

#define WRAPPED_CAPACITY 32 /* candidates */
#if WRAPPED_CAPACITY > LIST_CAPACITY || SLOT < HULL_CAPACITY
#error "a list must hold all candidates, and a slot all faces of a hull"
#endif

inline bool is_found(const int *found, int j)
{
    const int16 same = (vload16(0, found) == j) | (vload16(1, found) == j);
    const int8 eight = same.lo | same.hi;
    const int4 four = eight.lo | eight.hi;
    const int2 two = four.lo | four.hi;
    return (two.lo | two.hi) < 0;
}

/* The candidates of generator i: its neighbors and, for each two consecutive ones, the other cell that borders on both.
   These may be neighbors after one change of topology. Returns their number; 0 if there is a wall, or too many. */
inline int find_candidates(int *found, int i, const face_rows_t *rows)
{
    int n, m;
    global const int *row = face_row(rows, i, &n);
    if (2 * n > WRAPPED_CAPACITY)
        return 0;
    for (int k = 0; k < WRAPPED_CAPACITY; ++k)
        found[k] = -1;
    int least = INT_MAX;
    for (int k = 0; k < n; ++k) {
        found[k] = row[k];
        least = min(least, row[k]);
    }
    if (least < 0)
        return 0;
    int count = n;
    for (int k = 0; k < n; ++k) {
        global const int *other = face_row(rows, row[k], &m);
        const int q = place_in_row(other, m, i);
        const int j = q == m ? -1 : other[q < 2 ? q - 2 + m : q - 2];
        if (j >= 0 && !is_found(found, j))
            found[count++] = j;
    }
    return count;
}

/* Wrap the cells of LANES listed generators from number `first` on, of `size`; see `wrap_marked`. */
inline void wrap_eight(int first, int size, global const int *listed, const face_rows_t *rows,
                       global const double *points, double4 box_lower, double4 box_upper, global int *slots,
                       global int *slot_counts)
{
    int found[LANES][WRAPPED_CAPACITY], own[LANES], counts[LANES];
    long wanted[LANES];
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        own[lane] = listed[min(first + lane, size - 1)];
        counts[lane] = find_candidates(found[lane], own[lane], rows);
        most = max(most, counts[lane]);
        wanted[lane] = counts[lane] > 0 && first + lane < size ? -1 : 0;
    }
    ROWS_BEHIND(near, WRAPPED_CAPACITY);
    list_t list;
    for (int lane = 0; lane < LANES; ++lane)
        for (int k = 0; k < most; ++k) {
            /* Skip the generator itself. */
            const int j = k < counts[lane] ? found[lane][k] : own[lane];
            put_behind(near, k, lane, j, points);
            LANE((int *)list.places, k, lane) = j;
        }
    const eight_t sites = load_listed_sites(own, points);
    const double8 x = origin_x(&sites), y = origin_y(&sites);
    const long8 lanes = vload8(0, wanted), known = convert_long8(vload8(0, counts));
    project_rows(near, most - 1, &sites);
    list.length = 0;
    list.largest2 = 0;
    list.nearest = 0;
    long8 doubt = 0;
    for (int k = 0; k < most; ++k) {
        double8 nx, ny;
        load_row(near, k, &nx, &ny);
        nx -= x;
        ny -= y;
        doubt |= (k < known) & (nx == 0) & (ny == 0);
        put_candidates(&list, nx, ny);
    }
    pad_list(&list);
    hull_t hull;
    double8 reach2, least;
    wrap_hulls(&hull, &list, lanes);
    measure_hulls(&hull, &list, &reach2, &least);
    doubt |= hull.lost | is_uncertain(&hull, &list, reach2, least);
#ifdef SPHERE
    /* Far generators are not among the candidates: they cannot cut cells that are small. */
    doubt |= !(reach2 < 1);
#else
    /* Walls are not among the candidates, so they must be out of reach. */
    const double8 away = min(min(x - box_lower.s0, box_upper.s0 - x), min(y - box_lower.s1, box_upper.s1 - y));
    doubt |= !(away > 0) | !(reach2 < away * away);
#endif
    long written[LANES], sizes[LANES];
    vstore8(lanes & ~doubt, 0, written);
    vstore8(hull.sizes, 0, sizes);
    const int end = min(size - first, LANES);
    for (int lane = 0; lane < end; ++lane) {
        const int w = first + lane, count = written[lane] ? (int)sizes[lane] : 0;
        int labels[HULL_CAPACITY];
        for (int k = 0; k < count; ++k)
            labels[k] = LANE((const int *)hull.places, k, lane);
        write_labels(labels, count, slots + w * SLOT);
        slot_counts[w] = count;
    }
}
