/* New generators in a polygon: keep them separate from their parents where a corner of the boundary hides a part of the
   cell from its generator, or the generator is in a corner. */
#include "geometry/domain.h"
#include "tessellation/clipped/outline.h"

#ifdef POLYGON
/* A position in the cell of x at a face, visible from x or not: the center x + m of the face, moved inwards by `way`
   for a boundary edge, but at most half-way to the opposite side. With layers (`fixed` > 0) it must be visible from x,
   unless x is on their edge, because hidden positions may belong to the layers. */
inline REAL2 place_at_face(const REAL *x, REAL2 m, int label, REAL way, int fixed, global const REAL2 *tangents,
                           DOMAIN_ARGS)
{
    const REAL from[2] = {x[0] + m.s0, x[1] + m.s1};
    REAL y[2] = {from[0], from[1]};
    if (label < 0) {
        const REAL2 t = BOUNDARY_TANGENT(label);
        y[0] -= way * t.s1;
        y[1] += way * t.s0;
        keep_inside(from, y, DOMAIN);
    }
    if (fixed > 0) {
        REAL seen[2] = {y[0], y[1]};
        keep_inside(x, seen, DOMAIN);
        if (seen[0] != x[0] || seen[1] != x[1])
            return (REAL2)(seen[0], seen[1]);
    }
    return (REAL2)(y[0], y[1]);
}

inline REAL squared_gap(const REAL *x, REAL2 y)
{
    const REAL2 d = y - (REAL2)(x[0], x[1]);
    return dot(d, d);
}

/* Keep the new generator from x to y inside the domain. If it is then closer to x than `least`, it goes to `other`,
   unless that is closer still. */
inline void keep_separate(const REAL *x, REAL *y, REAL least, REAL2 other, DOMAIN_ARGS)
{
    keep_inside(x, y, DOMAIN);
    const REAL gap2 = squared_gap(x, (REAL2)(y[0], y[1]));
    if (gap2 < least * least && squared_gap(x, other) > gap2) {
        y[0] = other.s0;
        y[1] = other.s1;
    }
}

/* The parent at x moves to y and the new generator to `child`, at a distance of |way|. If the boundary leaves at most
   an eighth of that, the parent stays at x, the new generator goes to the farthest face (from `begin` to `end`), and
   the result is true. */
inline bool separate_child(const REAL *x, REAL *y, REAL *child, REAL2 way, int fixed, global const int *neighbors,
                           global const FACE *face_centroids, int begin, int end, global const REAL2 *tangents,
                           DOMAIN_ARGS)
{
    const REAL apart2 = dot(way, way);
    if (squared_gap(y, (REAL2)(child[0], child[1])) > apart2 / 64)
        return false;
    REAL most = -1;
    for (int k = begin; k < end; ++k) {
        const REAL2 m = (REAL2)(face_centroids[2 * k], face_centroids[2 * k + 1]);
        const REAL2 at = place_at_face(x, m, neighbors[k], sqrt(apart2) / 2, fixed, tangents, DOMAIN);
        const REAL gap2 = squared_gap(x, at);
        if (gap2 > most) {
            most = gap2;
            child[0] = at.s0;
            child[1] = at.s1;
        }
    }
    y[0] = x[0];
    y[1] = x[1];
    return true;
}
#endif
