/* The vertices of a cell in 3D after its generator and neighbors have moved: by flips from its earlier vertices, or by
   a walk along its edges. */
#include "tessellation/cell_corners3d.h"
#include "tessellation/update_rows.h"

#define MOST_FLIPS 24

#define LINK(links, a, b) ((links)->at[(a)*MOST_FACES + (b)])

inline void link_corner(CORNERS *cell, LINKS *links, int v, int a, int b, int c)
{
    cell->at[v] = (uchar4)(a, b, c, 0);
    LINK(links, a, b) = LINK(links, b, c) = LINK(links, c, a) = v;
}

/* The face of vertex v that follows b, where b follows a. */
inline int third_face(const CORNERS *cell, int v, int a, int b)
{
    const uchar4 at = cell->at[v];
    return at.s0 != a && at.s0 != b ? at.s0 : (at.s1 != a && at.s1 != b ? at.s1 : at.s2);
}

/* The product y.p - 1/2 of a position and the plane of face f: positive beyond the plane. */
inline REAL beyond_plane(const CORNERS *cell, int f, REAL4 y)
{
    const REAL4 p = cell->planes[f];
    return fma(p.s0, y.s0, fma(p.s1, y.s1, p.s2 * y.s2)) - R(0.5);
}

/* The same for WIDTH faces. */
inline WIDE beyond_planes(const CORNERS *cell, int block, REAL4 y)
{
#if WIDTH == 1
    return beyond_plane(cell, block, y);
#else
    int faces[WIDTH];
    for (int lane = 0; lane < WIDTH; ++lane)
        faces[lane] = WIDTH * block + lane;
    places_t p;
    WIDE d2;
    gather_lanes(&p, &d2, cell->planes, faces);
    return fma(p.x, y.s0, fma(p.y, y.s1, p.z * y.s2)) - R(0.5);
#endif
}

/* Find vertex v, and its largest product y.p - 1/2. False if its faces are not counter-clockwise. */
inline bool place_corner(CORNERS *cell, int v)
{
    const uchar4 at = cell->at[v];
    const REAL4 a = face_plane(cell, at.s0), b = face_plane(cell, at.s1), c = face_plane(cell, at.s2);
    const REAL4 ab = cross(a, b), bc = cross(b, c), ca = cross(c, a);
    const REAL det = dot(a, bc);
    if (!(det > 0))
        return false;
    const REAL4 y = (ab + bc + ca) / (2 * det);
    NUMBERS(cell->x)[v] = y.s0;
    NUMBERS(cell->y)[v] = y.s1;
    NUMBERS(cell->z)[v] = y.s2;
    WIDE beyond = -1;
    for (int block = 0; WIDTH * block < cell->faces; ++block) {
        const WIDE s = beyond_planes(cell, block, y);
        beyond = s > beyond ? s : beyond;
    }
    NUMBERS(cell->beyond)[v] = largest_lane(beyond);
    return true;
}

/* Move the last vertex to the place of vertex v, which is removed. */
inline void remove_corner(CORNERS *cell, LINKS *links, int v)
{
    const int last = --cell->corners;
    if (v == last)
        return;
    const uchar4 at = cell->at[last];
    link_corner(cell, links, v, at.s0, at.s1, at.s2);
    NUMBERS(cell->x)[v] = NUMBERS(cell->x)[last];
    NUMBERS(cell->y)[v] = NUMBERS(cell->y)[last];
    NUMBERS(cell->z)[v] = NUMBERS(cell->z)[last];
    NUMBERS(cell->beyond)[v] = NUMBERS(cell->beyond)[last];
}

/* Replace the edge between faces a and b, at vertices v = (a, b, c) and (b, a, e), by one between c and e; or remove
   face a or b if it is a triangle. False if that is impossible. */
inline bool flip_edge(CORNERS *cell, LINKS *links, int v, int a, int b, int c)
{
    const int w = LINK(links, b, a), e = third_face(cell, w, b, a);
    if (LINK(links, c, e) == NO_CORNER && LINK(links, e, c) == NO_CORNER) {
        LINK(links, a, b) = LINK(links, b, a) = NO_CORNER;
        link_corner(cell, links, v, c, a, e);
        link_corner(cell, links, w, e, b, c);
        return place_corner(cell, v) && place_corner(cell, w);
    }
    /* The third vertex (a, c, e) of a triangle a, or (b, e, c) of a triangle b. */
    const bool first = LINK(links, a, c) != NO_CORNER && LINK(links, a, c) == LINK(links, c, e);
    const int gone = first ? a : b, u = first ? LINK(links, a, c) : LINK(links, b, e);
    if (!first && (u == NO_CORNER || u != LINK(links, e, c)))
        return false;
    const int other = first ? b : a;
    LINK(links, gone, c) = LINK(links, c, gone) = LINK(links, gone, e) = LINK(links, e, gone) = NO_CORNER;
    LINK(links, a, b) = LINK(links, b, a) = NO_CORNER;
    if (first)
        link_corner(cell, links, v, other, c, e);
    else
        link_corner(cell, links, v, other, e, c);
    cell->planes[gone].xyz = 0;
    const int high = max(u, w), low = min(u, w);
    int place = v == cell->corners - 1 ? high : v;
    remove_corner(cell, links, high);
    place = place == cell->corners - 1 ? low : place;
    remove_corner(cell, links, low);
    return place_corner(cell, place);
}

/* Flip edges until all vertices lie in the cell. False if the cell remains wrong. */
inline bool flip_corners(CORNERS *cell, LINKS *links)
{
    for (int flips = 0; flips < MOST_FLIPS; ++flips) {
        int worst = 0;
        LANE_SPACE const REAL *beyond = NUMBERS(cell->beyond);
        for (int v = 1; v < cell->corners; ++v)
            worst = beyond[v] > beyond[worst] ? v : worst;
        if (!(beyond[worst] > BEYOND_NOISE))
            return true;
        const REAL4 y = corner_place(cell, worst);
        const uchar4 at = cell->at[worst];
        int a = at.s0, b = at.s1, c = at.s2, best_a = -1, best_b = 0, best_c = 0;
        REAL most = BEYOND_NOISE;
        for (int edge = 0; edge < 3; ++edge) {
            const int other = LINK(links, b, a);
            const REAL s = beyond_plane(cell, third_face(cell, other, b, a), y);
            if (s > most) {
                most = s;
                best_a = a;
                best_b = b;
                best_c = c;
            }
            const int first = a;
            a = b;
            b = c;
            c = first;
        }
        if (best_a < 0 || !flip_edge(cell, links, worst, best_a, best_b, best_c))
            return false;
    }
    return false;
}

/* Flip edges, then cut the cell by the planes from number `known` on, one after the other: the vertex farthest beyond a
   plane is replaced by three, and edges are flipped. Its vertices are linked. False if the cell remains wrong. */
inline bool repair_corners(CORNERS *cell, LINKS *links, int known)
{
    const int end = cell->faces;
    REAL4 planes[MORE];
    for (int f = known; f < end; ++f) {
        planes[f - known] = face_plane(cell, f);
        cell->planes[f].xyz = 0;
    }
    bool right = flip_corners(cell, links);
    for (int f = known; f < end && right; ++f) {
        const REAL4 plane = planes[f - known];
        cell->planes[f].xyz = plane.xyz;
        LANE_SPACE REAL *beyond = NUMBERS(cell->beyond);
        REAL most = BEYOND_NOISE;
        int worst = -1;
        for (int v = 0; v < cell->corners; ++v) {
            const REAL s = beyond_plane(cell, f, corner_place(cell, v));
            beyond[v] = fmax(beyond[v], s);
            worst = s > most ? v : worst;
            most = fmax(most, s);
        }
        if (worst < 0)
            continue;
        const uchar4 at = cell->at[worst];
        const int next = cell->corners;
        cell->corners += 2;
        link_corner(cell, links, worst, at.s0, at.s1, f);
        link_corner(cell, links, next, at.s1, at.s2, f);
        link_corner(cell, links, next + 1, at.s2, at.s0, f);
        right = place_corner(cell, worst) && place_corner(cell, next) && place_corner(cell, next + 1) &&
                flip_corners(cell, links);
    }
    return right;
}

/* The face that cuts a ray from y along `ray` first, except a and b; -1 if there is none. */
inline int first_cut(const CORNERS *cell, REAL4 y, REAL4 ray, int a, int b)
{
    WIDE least = INFINITY, faces = -1;
    for (int block = 0; WIDTH * block < cell->faces; ++block) {
        const WIDE slack = fmax(-beyond_planes(cell, block, y), (WIDE)0), face = WIDTH * block + LANE_NUMBERS;
        const WIDE speed = beyond_planes(cell, block, ray) + R(0.5), way = slack / speed;
        const WIDE allowed = ((speed > 0) & (face != a) & (face != b)) ? way : (WIDE)INFINITY;
        faces = allowed < least ? face : faces;
        least = fmin(allowed, least);
    }
    REAL ways[WIDTH], numbers[WIDTH];
    STORE_WIDE(least, 0, ways);
    STORE_WIDE(faces, 0, numbers);
    int first = -1;
    REAL way = INFINITY;
    for (int lane = 0; lane < WIDTH; ++lane) {
        first = ways[lane] < way ? (int)numbers[lane] : first;
        way = fmin(ways[lane], way);
    }
    return first;
}

/* Find all vertices by a walk along the edges. There are no links before. False if the cell is open, or round-off
   leaves it so. */
inline bool walk_corners(CORNERS *cell, LINKS *links)
{
    cell->corners = 0;
    int nearest = 0;
    for (int f = 1; f < cell->faces; ++f)
        nearest = cell->planes[f].s3 < cell->planes[nearest].s3 ? f : nearest;
    if (!(cell->planes[nearest].s3 > 0))
        return false;
    int a = nearest;
    const REAL4 p = face_plane(cell, a);
    const REAL4 size = fabs(p);
    const bool flat_x = size.s0 <= size.s1 && size.s0 <= size.s2, flat_y = !flat_x && size.s1 <= size.s2;
    const REAL4 axis = (REAL4)(flat_x, flat_y, !(flat_x || flat_y), 0);
    REAL4 y = p * (cell->planes[a].s3 / 2), ray = cross(p, axis);
    int b = first_cut(cell, y, ray, a, a);
    if (b < 0)
        return false;
    const REAL4 q = face_plane(cell, b);
    y += ray * (-beyond_plane(cell, b, y) / dot(q, ray));
    uchar4 edges[MOST_CORNERS + 4]; /* to be walked: two consecutive faces at a vertex, and the vertex */
    int open = 0;
    for (;;) {
        ray = cross(face_plane(cell, a), face_plane(cell, b));
        const int c = first_cut(cell, y, ray, a, b), v = cell->corners;
        if (c < 0 || v == MOST_CORNERS - 1 || LINK(links, a, b) != NO_CORNER || LINK(links, b, c) != NO_CORNER ||
            LINK(links, c, a) != NO_CORNER)
            return false;
        ++cell->corners;
        link_corner(cell, links, v, a, b, c);
        if (!place_corner(cell, v))
            return false;
        edges[open++] = (uchar4)(b, c, v, 0);
        edges[open++] = (uchar4)(c, a, v, 0);
        if (v == 0)
            edges[open++] = (uchar4)(a, b, v, 0);
        do {
            if (open == 0)
                return true;
            const uchar4 edge = edges[--open];
            /* At the other end the faces are in the opposite order. */
            a = edge.s1;
            b = edge.s0;
            y = corner_place(cell, edge.s2);
        } while (LINK(links, a, b) != NO_CORNER);
        if (open > MOST_CORNERS)
            return false;
    }
}
