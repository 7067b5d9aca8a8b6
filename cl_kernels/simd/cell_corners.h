/* The corners of eight cells at a time, one per vector lane, with the same bits as `corner` (tessellation/corner.h)
   where no wall is involved. */
#include "tessellation/face_rows.h"
#include "simd/eight_sites.h"
#include "simd/lanes.h"

inline double8 cross_in_plane(double8 a, double8 b, double8 c, double8 d)
{
    const double8 cd = c * d;
    return fma(a, b, -cd) + fma(-c, d, cd);
}

/* Points along outlines, relative to the generators. */
typedef struct {
    double8 x[ROW_CAPACITY], y[ROW_CAPACITY];
} outlines_t;

/* The first `most` corners of cells with generators at (x, y), corner k between faces k and k + 1, from the positions
   of the neighbors. */
inline void find_corners(outlines_t *corners, const double2 *behind, int most, double8 x, double8 y)
{
    double8 ax, ay;
    load_row(behind, 0, &ax, &ay);
    double8 ux = ax - x, uy = ay - y;
    double8 u2 = ux * ux + uy * uy;
    for (int k = 0; k < most; ++k) {
        double8 bx, by;
        load_row(behind, k + 1, &bx, &by);
        const double8 vx = bx - x, vy = by - y, wx = bx - ax, wy = by - ay;
        const double8 v2 = vx * vx + vy * vy, w2 = wx * wx + wy * wy;
        /* As in `corner`: from u and v, or from w and -u if these are near each other. */
        const long8 apart = w2 > 1e-3 * u2;
        const double8 px = apart ? ux : wx, py = apart ? uy : wy, p2 = apart ? u2 : w2;
        const double8 qx = apart ? vx : -ux, qy = apart ? vy : -uy, q2 = apart ? v2 : u2;
        const double8 inverse = 0.5 / cross_in_plane(px, qy, py, qx);
        const double8 cx = cross_in_plane(p2, qy, q2, py) * inverse, cy = cross_in_plane(q2, px, p2, qx) * inverse;
        corners->x[k] = apart ? cx : cx + ux;
        corners->y[k] = apart ? cy : cy + uy;
        ax = bx;
        ay = by;
        ux = vx;
        uy = vy;
        u2 = v2;
    }
}
