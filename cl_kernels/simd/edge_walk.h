/* Cells in 3D, traced along their edges, one per vector lane. An edge starts at a vertex, lies on two bisectors and
   ends where the next bisector cuts it. All lanes take the same steps. A vertex is the triangle of its three faces,
   counter-clockwise seen from outside. */
#include "simd/walk_state.h"

/* Bisectors are moved outwards by this share of the distance of the generator, so that the two of an edge do not
   cut it. Faces missed by this are smaller than the limit of certainty. */
#define BIAS 1e-14
/* Least squared volume spanned by the normals of the three faces at a certain vertex. */
#define CERTAIN_SINE2 1e-10

#define NO_FACE 255

/* The first cut of a ray: at slack / speed from its start, by entry `at` of the list, or none so far (-1). */
typedef struct {
    double8 slack, speed;
    long8 at;
} stop_t;

/* Cut a ray from `y` (given as -y) along `ray` by entry k. */
inline void cut_ray(stop_t *stop, const list_t *list, int k, vectors_t minus_y, vectors_t ray)
{
    const double8 x = list->planes[k].x, y = list->planes[k].y, z = list->planes[k].z;
    /* At least 0: round-off may put y beyond its own bisectors, which would then seem to cut a ray that leaves them. */
    double8 slack = fma(minus_y.x, x, fma(minus_y.y, y, fma(minus_y.z, z, 0.5 + BIAS)));
    slack = slack > 0 ? slack : 0;
    const double8 speed = fma(ray.x, x, fma(ray.y, y, ray.z * z));
    const long8 sooner = fma(speed, stop->slack, -stop->speed * slack) > 0;
    stop->slack = sooner ? slack : stop->slack;
    stop->speed = sooner ? speed : stop->speed;
    stop->at = sooner ? (long8)k : stop->at;
}

/* Go from y along `ray` to the next vertex, which is returned; `inverse` is 1 / speed. */
inline vectors_t walk_ray(stop_t *stop, double8 *inverse, const list_t *list, vectors_t y, vectors_t ray, long8 active)
{
    const vectors_t minus_y = {-y.x, -y.y, -y.z};
    /* Two independent chains of comparisons, which the processor overlaps. */
    stop_t even = {1, 0, -1}, odd = even;
    int k = 0;
    for (int shell = 0; shell < SHELLS; ++shell) {
        for (; k < list->ends[shell]; k += 2) {
            cut_ray(&even, list, k, minus_y, ray);
            cut_ray(&odd, list, k + 1, minus_y, ray);
        }
        const long8 sooner = fma(odd.speed, even.slack, -even.speed * odd.slack) > 0;
        stop->slack = sooner ? odd.slack : even.slack;
        stop->speed = sooner ? odd.speed : even.speed;
        stop->at = sooner ? odd.at : even.at;
        /* A generator farther from x than twice the vertex cannot cut it. */
        const vectors_t scaled = {fma(stop->speed, y.x, stop->slack * ray.x),
                                  fma(stop->speed, y.y, stop->slack * ray.y),
                                  fma(stop->speed, y.z, stop->slack * ray.z)};
        const double8 limit = list->radii2[shell] * stop->speed * stop->speed;
        if (shell == SHELLS - 1 || !any(active & ~(4 * dot8(scaled, scaled) < limit)))
            break;
    }
    *inverse = 1 / stop->speed;
    return along8(y, (stop->slack - BIAS) * *inverse, ray);
}

/* The face of entry k of the list of a lane, a new one if needed; HULL_CAPACITY if there is no room. Known data is
   written again, as mispredicted branches cost more. */
inline int face_of_entry(cells_t *cells, lane_walk_t *own, const list_t *list, int k, int lane)
{
    const int known = own->face_of[k], next = cells->faces[lane];
    const bool is_new = known == NO_FACE;
    const int f = is_new ? next : known;
    own->face_of[k] = f;
    cells->faces[lane] = next + (is_new && next < HULL_CAPACITY);
    for (int component = 0; component < 4; ++component)
        PLANE_LANE(cells->planes, f, component, lane) = PLANE_LANE(list->planes, k, component, lane);
    LANE(cells->places, f, lane) = LANE(list->places, k, lane);
    return f;
}

/* Record vertex number `corner` between faces a, b, c. False if this vertex exists already. */
inline bool put_corner(lane_walk_t *own, int a, int b, int c, int corner)
{
    const ulong sides_a = own->sides[a] | 1UL << b, sides_b = own->sides[b], sides_c = own->sides[c];
    if (a == c || b == c || (((own->sides[a] >> b) | (sides_b >> c) | (sides_c >> a)) & 1) != 0)
        return false;
    own->sides[a] = sides_a;
    own->sides[b] = sides_b | 1UL << c;
    own->sides[c] = sides_c | 1UL << a;
    own->corner_faces[corner] = (uchar4)(a, b, c, 0);
    /* Edges with an unknown other side must be traced. */
    int open = own->open;
    own->edges[open] = (uchar4)(b, c, corner, 0);
    open += !((sides_c >> b) & 1);
    own->edges[open] = (uchar4)(c, a, corner, 0);
    open += !((sides_a >> c) & 1);
    own->open = open;
    return true;
}

/* Choose the next edge of a lane, if any. */
inline void next_edge(walk_t *walk, int lane)
{
    lane_walk_t *own = &walk->lanes[lane];
    int open = own->open;
    walk->active[lane] = 0;
    while (open > 0) {
        const uchar4 edge = own->edges[--open];
        if ((own->sides[edge.s1] >> edge.s0) & 1)
            continue;
        /* At the other end the faces are in the opposite order. */
        walk->a[lane] = edge.s1;
        walk->b[lane] = edge.s0;
        walk->from[lane] = edge.s2;
        walk->active[lane] = -1;
        break;
    }
    own->open = open;
}

/* Trace the cells of the chosen lanes. */
inline void walk_cells(cells_t *cells, walk_t *walk, const list_t *list, long8 chosen)
{
    cells->reach2 = 0;
    cells->planes[HULL_CAPACITY].d2 = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        lane_walk_t *own = &walk->lanes[lane];
        own->open = 0;
        for (int k = 0; k < HULL_CAPACITY; ++k)
            own->sides[k] = 0;
        for (int k = 0; k < LIST_CAPACITY; ++k)
            own->face_of[k] = NO_FACE;
    }
    /* The face of the nearest generator exists. Go from its foot point to any edge of the face. */
    long first[LANES], second[LANES];
    vstore8(list->nearest, 0, first);
    const double8 middle = PLANE_LANES(list->planes, first, 3) / 2;
    vectors_t a = planes_at(list->planes, first);
    vectors_t y = {a.x * middle, a.y * middle, a.z * middle};
    const long8 flat_x = (fabs(a.x) <= fabs(a.y)) & (fabs(a.x) <= fabs(a.z)),
                flat_y = ~flat_x & (fabs(a.y) <= fabs(a.z));
    const vectors_t axis = {flat_x ? 1.0 : 0.0, flat_y ? 1.0 : 0.0, (flat_x | flat_y) ? 0.0 : 1.0};
    const long8 usable = list->nearest2 > 0;
    stop_t stop;
    double8 inverse;
    y = walk_ray(&stop, &inverse, list, y, cross_in_space(a, axis), chosen & usable);
    vstore8(chosen & ~usable, 0, cells->doubt);
    vstore8(stop.at, 0, second);
    for (int lane = 0; lane < LANES; ++lane) {
        cells->faces[lane] = cells->corners[lane] = 0;
        cells->lost[lane] = second[lane] < 0 || second[lane] == first[lane] ? -1 : 0;
        face_of_entry(cells, &walk->lanes[lane], list, first[lane], lane);
        face_of_entry(cells, &walk->lanes[lane], list, max(second[lane], 0L), lane);
        walk->a[lane] = walk->from[lane] = 0;
        walk->b[lane] = cells->faces[lane] - 1; /* 1, unless the second face is missing */
    }
    vstore8(chosen & usable & ~vload8(0, cells->lost), 0, walk->active);
    a = planes_at(cells->planes, walk->a);
    vectors_t b = planes_at(cells->planes, walk->b), ab = cross_in_space(a, b);
    long8 active = vload8(0, walk->active);
    for (int corner = 0; any(active) && corner < CORNER_CAPACITY; ++corner) {
        const vectors_t end = walk_ray(&stop, &inverse, list, y, ab, active);
        long entries[LANES], certain[LANES], now[LANES];
        vstore8(stop.at < 0 ? 0 : stop.at, 0, entries);
        const vectors_t c = planes_at(list->planes, entries);
        const vectors_t bc = cross_in_space(b, c), ca = cross_in_space(c, a);
        const double8 a2 = dot8(a, a), b2 = dot8(b, b), c2 = dot8(c, c);
        /* Round-off of the steps does not accumulate. */
        y = along8(end, (0.5 - dot8(a, end)) * inverse, bc);
        y = along8(y, (0.5 - dot8(b, end)) * inverse, ca);
        y = along8(y, (0.5 - dot8(c, end)) * inverse, ab);
        walk->corners[corner].x = y.x;
        walk->corners[corner].y = y.y;
        walk->corners[corner].z = y.z;
        vstore8(stop.speed * stop.speed > CERTAIN_SINE2 * a2 * b2 * c2, 0, certain);
        const long8 none = stop.at < 0;
        vstore8(vload8(0, cells->lost) | (active & none), 0, cells->lost);
        vstore8(active & ~none, 0, now);
        for (int lane = 0; lane < LANES; ++lane) {
            walk->active[lane] = 0;
            if (!now[lane])
                continue;
            lane_walk_t *own = &walk->lanes[lane];
            const int f = face_of_entry(cells, own, list, entries[lane], lane);
            const int fa = walk->a[lane], fb = walk->b[lane];
            if (f == fa || f == fb) {
                cells->lost[lane] = -1;
                now[lane] = 0;
            } else if (f == HULL_CAPACITY || !certain[lane] || !put_corner(own, fa, fb, f, corner)) {
                cells->doubt[lane] = -1;
                now[lane] = 0;
            } else {
                ++cells->corners[lane];
                if (corner == 0)
                    own->edges[own->open++] = (uchar4)(fa, fb, corner, 0);
                next_edge(walk, lane);
            }
        }
        const long8 some = vload8(0, now);
        cells->reach2 = some ? fmax(cells->reach2, dot8(y, y)) : cells->reach2;
        active = vload8(0, walk->active);
        y = planes_at(walk->corners, walk->from);
        a = planes_at(cells->planes, walk->a);
        b = planes_at(cells->planes, walk->b);
        ab = cross_in_space(a, b);
    }
    /* All edges have two sides, and Euler's formula holds. */
    for (int lane = 0; lane < LANES; ++lane)
        if (walk->active[lane] || cells->corners[lane] != 2 * cells->faces[lane] - 4)
            cells->doubt[lane] = -1;
}
