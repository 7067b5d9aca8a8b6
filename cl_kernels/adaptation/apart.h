/* New generators in a polygon: apart from those that bring them, also where a corner of the boundary hides a cell from
   its generator, or the generator stands in a corner. */
#include "geometry/domain.h"
#include "tessellation/clipped/outline.h"

#ifdef POLYGON
/* A place in the cell of x whether it is seen from there or not: the middle of a face, x + m, or `way` inwards from
   that of one on the boundary; half-way to what is across from it, if that is nearer. Where layers keep a part of the
   cells for themselves (`fixed` > 0) it is to be seen from x, as what is hidden may be theirs, unless x stands on their
   edge. */
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

/* Keep the new generator that comes from x to y inside, as `keep_inside` does. If that puts it nearer to x than `least`
   it goes to `other` instead, unless that is nearer still. */
inline void keep_apart(const REAL *x, REAL *y, REAL least, REAL2 other, DOMAIN_ARGS)
{
    keep_inside(x, y, DOMAIN);
    const REAL gap2 = squared_gap(x, (REAL2)(y[0], y[1]));
    if (gap2 < least * least && squared_gap(x, other) > gap2) {
        y[0] = other.s0;
        y[1] = other.s1;
    }
}

/* The generator at x and a new one have been sent to y and `child`, which were to be `way` apart. If the boundary has
   left an eighth of that or less, the generator stays, and the new one goes to the face that is farthest away, of those
   behind `begin` up to `end`; true. */
inline bool take_apart(const REAL *x, REAL *y, REAL *child, REAL2 way, int fixed, global const int *neighbors,
                       global const FACE *face_centroids, int begin, int end, global const REAL2 *tangents, DOMAIN_ARGS)
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
