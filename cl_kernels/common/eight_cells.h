/* The measures of eight cells at a time, one in each lane of vectors: bit by bit those of `measure_cell`. Cells with a
   wall among their faces are left to that. */
#include "common/eight_corners.h"
#include "common/measures.h"

/* Measure the cells of LANES generators from number `first` on. */
inline void measure_eight(const measures_t *to, int first, int size, const face_rows_t *rows, global const uint *keep,
                          global const double *points, const double *lower, const double *upper)
{
    int faces[LANES][ROW_CAPACITY];
    double2 behind[(ROW_CAPACITY + 1) * LANES];
    double xs[LANES], ys[LANES];
    long counts[LANES], inside[LANES];
    int most = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const int i = min(first + lane, size - 1);
        const int place = rows->places[i];
        global const uint *words = keep + max(place, 0) * KEEP_WORDS;
        int listed, n = 0, least = INT_MAX;
        global const int *row = face_row(rows, i, &listed);
        behind[ROW_PLACE(0, lane)] = vload2(i, points);
        for (int k = 0; k < listed; ++k) {
            const int face = row[k];
            const bool kept = place < 0 || ((words[k / 32] >> (k % 32)) & 1u);
            faces[lane][n] = face;
            behind[ROW_PLACE(n, lane)] = vload2(max(face, 0), points);
            least = kept ? min(least, face) : least;
            n += kept;
        }
        counts[lane] = n;
        inside[lane] = n >= 3 && least >= 0 ? -1 : 0;
        most = max(most, n);
        xs[lane] = points[2 * i];
        ys[lane] = points[2 * i + 1];
    }
    /* Outlines of fewer faces begin again. */
    for (int lane = 0; lane < LANES; ++lane)
        for (int k = max((int)counts[lane], 1); k <= most; ++k)
            behind[ROW_PLACE(k, lane)] = behind[ROW_PLACE(k - max((int)counts[lane], 1), lane)];
    outlines_t corners;
    find_corners(&corners, behind, most, vload8(0, xs), vload8(0, ys));

    outlines_t middles;
    double8 lengths[ROW_CAPACITY];
    double8 area = 0, cx = 0, cy = 0, xx = 0, xy = 0, yy = 0;
    const long8 ends = vload8(0, counts), last = max(ends - 1, (long8)(0));
    double8 vx = pick(corners.x, last), vy = pick(corners.y, last);
    for (int k = 0; k < most; ++k) {
        const double8 wx = corners.x[k], wy = corners.y[k];
        const double8 ex = wx - vx, ey = wy - vy, sx = vx + wx, sy = vy + wy;
        lengths[k] = sqrt(ex * ex + ey * ey);
        middles.x[k] = sx / 2;
        middles.y[k] = sy / 2;
        /* As `add_triangle` has it. */
        const double8 cross = k < ends ? cross8(vx, wy, vy, wx) : 0;
        area += cross;
        cx += cross * sx;
        cy += cross * sy;
        xx += cross * (vx * vx + wx * wx + sx * sx);
        xy += cross * (vx * vy + wx * wy + sx * sy);
        yy += cross * (vy * vy + wy * wy + sy * sy);
        vx = wx;
        vy = wy;
    }
    /* As `write_moments` has it. */
    const long8 full = area > 0;
    const double8 mx = full ? cx / (3 * area) : cx, my = full ? cy / (3 * area) : cy;
    double results[6 * LANES];
    vstore8(area / 2, 0, results);
    vstore8(mx, 1, results);
    vstore8(my, 2, results);
    vstore8(full ? xx / (12 * area) - mx * mx : xx, 3, results);
    vstore8(full ? xy / (12 * area) - mx * my : xy, 4, results);
    vstore8(full ? yy / (12 * area) - my * my : yy, 5, results);
    for (int lane = 0; lane < LANES && first + lane < size; ++lane) {
        const int i = first + lane, start = to->starts[i];
        if (!inside[lane]) {
            measure_cell(to, i, faces[lane], counts[lane], points, lower, upper);
            continue;
        }
        for (int k = 0; k < counts[lane]; ++k)
            put_face(to, start + k, faces[lane][k], LANE((const double *)lengths, k, lane),
                     LANE((const double *)middles.x, k, lane), LANE((const double *)middles.y, k, lane));
        to->volumes[i] = LANE(results, 0, lane);
        for (int a = 0; a < 2; ++a)
            to->offsets[2 * i + a] = LANE(results, 1 + a, lane);
        for (int a = 0; a < 3; ++a)
            to->covariances[3 * i + a] = LANE(results, 3 + a, lane);
    }
}
