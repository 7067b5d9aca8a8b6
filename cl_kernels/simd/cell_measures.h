/* The measures of eight cells at a time, one per vector lane, with the same bits as `measure_cell`, which handles cells
   with walls. */
#include "simd/cell_corners.h"
#include "tessellation/measures.h"

#define FACE8 CLVORO_JOIN(FACE, 8)
#define FACE16 CLVORO_JOIN(FACE, 16)
#define CONVERT_FACE8 CLVORO_JOIN(convert_, FACE8)

/* Whether the bits in `words` keep all n faces. */
inline bool keeps_all(global const uint *words, int n)
{
    bool all = true;
    for (; n > 0; n -= 32, ++words)
        all &= *words == (n < 32 ? (1u << n) - 1 : ~0u);
    return all;
}

/* Rows of LANES cells, all of them up to the length of the longest. */
typedef struct {
    int first, size; /* numbers of the first generator, and of all */
    int most, end;   /* length of the longest row, and the end of the last one in the arrays of faces */
    long counts[LANES];
    bool inside[LANES]; /* rows that the lanes measure; `measure_cell` measures the others */
    eight_t sites;
    outlines_t corners;
} eight_rows_t;

#ifdef SPHERE
#include "simd/sphere_cells.h"
#else
#define measure_outlines measure_plane_outlines

/* Measure the cells, and write the measures. */
inline void measure_plane_outlines(const measures_t *to, eight_rows_t *all, const face_rows_t *rows,
                                   global const uint *keep, global const double *points, const double *lower,
                                   const double *upper)
{
    const outlines_t *corners = &all->corners;
    const int most = all->most, first = all->first;
    FACE8 lengths[ROW_CAPACITY];
    FACE16 middles[ROW_CAPACITY];
    double8 area = 0, cx = 0, cy = 0, xx = 0, xy = 0, yy = 0, far2 = 0;
    const long8 ends = vload8(0, all->counts), last = max(ends - 1, (long8)(0));
    double8 vx = pick(corners->x, last), vy = pick(corners->y, last);
    for (int k = 0; k < most; ++k) {
        const long8 here = k < ends;
        const double8 wx = here ? corners->x[k] : 0, wy = here ? corners->y[k] : 0;
        const double8 ex = wx - vx, ey = wy - vy, sx = vx + wx, sy = vy + wy;
        far2 = fmax(far2, wx * wx + wy * wy);
        lengths[k] = CONVERT_FACE8(sqrt(ex * ex + ey * ey));
        middles[k].even = CONVERT_FACE8(sx / 2);
        middles[k].odd = CONVERT_FACE8(sy / 2);
        /* As in `add_triangle`. */
        const double8 cross = here ? cross_in_plane(vx, wy, vy, wx) : 0;
        area += cross;
        cx += cross * sx;
        cy += cross * sy;
        xx += cross * (vx * vx + wx * wx + sx * sx);
        xy += cross * (vx * vy + wx * wy + sx * sy);
        yy += cross * (vy * vy + wy * wy + sy * sy);
        vx = wx;
        vy = wy;
    }
    /* As in `write_moments`. */
    const long8 full = area > 0;
    const double8 mx = full ? cx / (3 * area) : cx, my = full ? cy / (3 * area) : cy;
    double results[7 * LANES];
    vstore8(area / 2, 0, results);
    vstore8(mx, 1, results);
    vstore8(my, 2, results);
    vstore8(full ? xx / (12 * area) - mx * mx : xx, 3, results);
    vstore8(full ? xy / (12 * area) - mx * my : xy, 4, results);
    vstore8(full ? yy / (12 * area) - my * my : yy, 5, results);
    vstore8(far2, 6, results);
    for (int lane = 0; lane < LANES && first + lane < all->size; ++lane) {
        const int i = first + lane, start = to->starts[i];
        if (!all->inside[lane]) {
            int faces[ROW_CAPACITY];
            const int n = kept_faces(faces, rows, keep, i);
            measure_cell(to, i, faces, n, points, lower, upper);
            continue;
        }
        for (int k = 0; k < min(most, all->end - start); ++k) {
            to->face_measures[start + k] = LANE((const FACE *)lengths, k, lane);
            vstore2(vload2(k * LANES + lane, (const FACE *)middles), start + k, to->face_centroids);
        }
        to->volumes[i] = LANE(results, 0, lane);
        for (int a = 0; a < 2; ++a)
            to->offsets[2 * i + a] = LANE(results, 1 + a, lane);
        for (int a = 0; a < 3; ++a)
            to->covariances[3 * i + a] = LANE(results, 3 + a, lane);
        write_reach(to, i, LANE(results, 6, lane));
    }
}
#endif

/* Measure the cells of LANES generators from number `first` on. Without `places` their rows lie in the graph already.
 */
inline void measure_eight(const measures_t *to, int first, int size, const face_rows_t *rows, global const uint *keep,
                          global const double *points, const double *lower, const double *upper)
{
    ROWS_BEHIND(behind, ROW_CAPACITY + 1);
    eight_rows_t all;
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const int i = min(first + lane, size - 1), place = place_of_row(rows, i);
        int n;
        face_row(rows, i, &n);
        /* `measure_cell` also handles rows with dropped faces. */
        all.counts[lane] = n >= 3 && (place < 0 || keeps_all(keep + place, n)) ? n : 0;
        most = max(most, (int)all.counts[lane]);
    }
    /* All rows are processed up to the length of the longest, as branches on different lengths would be mispredicted.
       Behind its last face a row repeats its first; what it writes into the next row is overwritten later. */
    const int end = to->starts[min(first + LANES, size)];
    for (int lane = 0; lane < LANES; ++lane) {
        const int i = min(first + lane, size - 1), n = all.counts[lane];
        const int start = first + lane < size ? to->starts[i] : end;
        int least = INT_MAX, listed;
        global const int *row = face_row(rows, i, &listed);
        for (int k = 0; k <= most; ++k) {
            const int face = n > 0 ? row[k < n ? k : 0] : -1;
            least = min(least, face);
            put_behind(behind, k, lane, max(face, 0), points);
            if (rows->places && start + k < end)
                to->neighbors[start + k] = face;
        }
        all.inside[lane] = least >= 0;
    }
    all.first = first;
    all.size = size;
    all.most = most;
    all.end = end;
    all.sites = load_sites(first, size, points);
    project_rows(behind, most, &all.sites);
    find_corners(&all.corners, behind, most, origin_x(&all.sites), origin_y(&all.sites));
    measure_outlines(to, &all, rows, keep, points, lower, upper);
}
