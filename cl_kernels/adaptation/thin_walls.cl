/* Pairs of generators on both sides of a wall that is thinner than a cell. The diagram is computed without walls: the
   cell of a generator beside a thin wall extends to the other side, and that part is then cut off. This does not happen
   if the generators on both sides are mirror images of each other.

   Pairs move towards their images by a share. It is 1 up to a thickness of THIN h / 2, and falls linearly to 0 at
   THIN h, so that it is continuous along a wall that widens. Where the sizes of both sides differ there are no pairs,
   because a row of cells has no image in a row with fewer cells.

   THIN  largest thickness of a thin wall over h */
#include "geometry/edges.h"

/* Largest distance over h of a generator from the image of the other one, and sine of the largest angle between the two
   sides of the wall. */
#define PAIRED R(0.45)
#define PARALLEL R(0.5)
/* Largest ratio of the sizes of two generators that are a pair. */
#define ALIKE R(1.15)
/* Step over h of a generator without a partner. */
#define PUSH R(0.1)

/* The image of y at the middle of the wall between x and y, and the share by which pairs move towards their images;
   false if no thin wall is between them. */
inline bool image_across(REAL2 x, REAL2 y, REAL h, REAL2 *image, REAL *share, DOMAIN_ARGS)
{
    const REAL here[2] = {x.s0, x.s1}, there[2] = {y.s0, y.s1};
    const REAL apart = sqrt(dot(y - x, y - x));
    int edge, other;
    const REAL t = exit_over_edge(here, there, &edge, DOMAIN);
    if (t > 1)
        return false;
    const REAL s = exit_over_edge(there, here, &other, DOMAIN);
    *share = fmin(R(1), 2 - 2 * (1 - t - s) * apart / (R(THIN) * h));
    if (s > 1 || *share < 0)
        return false;
    REAL2 a = edge_ends[edge].s23 - edge_ends[edge].s01, b = edge_ends[other].s23 - edge_ends[other].s01;
    a /= sqrt(dot(a, a));
    b /= sqrt(dot(b, b));
    if (fabs(a.s0 * b.s1 - a.s1 * b.s0) > PARALLEL || dot(a, b) > 0)
        return false;
    REAL2 along = a - b;
    along /= sqrt(dot(along, along));
    const REAL2 middle = (x + t * (y - x) + y + s * (x - y)) / 2, v = y - middle;
    *image = middle + 2 * dot(v, along) * along - v;
    return true;
}

/* The generator whose image is nearest to generator i, -1 if there is none. Both are neighbors in the diagram without
   walls, but not in the diagram. */
inline int image_partner(int i, int n, global const int *convex_starts, global const int *convex_neighbors,
                         global const int *starts, global const int *neighbors, global const REAL2 *points,
                         global const REAL *h, global const int *labels, int fixed, DOMAIN_ARGS)
{
    int partner = -1;
    REAL least = PAIRED * h[i];
    for (int k = convex_starts[i]; k < convex_starts[i + 1]; ++k) {
        const int j = convex_neighbors[k];
        if (j < 0 || j >= n || labels[j] < fixed)
            continue;
        bool touches = false;
        for (int m = starts[i]; m < starts[i + 1]; ++m)
            touches = touches || neighbors[m] == j;
        REAL2 image;
        REAL share;
        const REAL least_h = fmin(h[i], h[j]);
        if (touches || fmax(h[i], h[j]) > ALIKE * least_h ||
            !image_across(points[i], points[j], least_h, &image, &share, DOMAIN))
            continue;
        const REAL away = sqrt(dot(image - points[i], image - points[i]));
        if (away < least) {
            least = away;
            partner = j;
        }
    }
    return partner;
}

/* partners[p] = the generator with the nearest image to cell p of those at the wall, if that holds in turn; -1 for
   none. The partner may be a cell that is not at the wall, because the other one reaches through. */
kernel void find_partners(const int size, global const int *cells, const int n, global const int *convex_starts,
                          global const int *convex_neighbors, global const int *starts, global const int *neighbors,
                          global const REAL2 *points, global const REAL *h, global const int *labels, const int fixed,
                          DOMAIN_ARGS, global int *partners)
{
    WORK_ITEM(p);
    const int i = cells[p];
    partners[p] = -1;
    if (i >= n || labels[i] < fixed)
        return;
    const int j =
        image_partner(i, n, convex_starts, convex_neighbors, starts, neighbors, points, h, labels, fixed, DOMAIN);
    if (j >= 0 &&
        image_partner(j, n, convex_starts, convex_neighbors, starts, neighbors, points, h, labels, fixed, DOMAIN) == i)
        partners[p] = j;
}

/* A share of half the way from generator i to the image of j; its position if a wall is in the way. */
inline REAL2 halfway_to_image(int i, int j, global const REAL2 *points, global const REAL *h, DOMAIN_ARGS)
{
    REAL2 image;
    REAL share;
    if (!image_across(points[i], points[j], fmin(h[i], h[j]), &image, &share, DOMAIN))
        return points[i];
    const REAL2 goal = points[i] + share / 2 * (image - points[i]);
    const REAL from[2] = {points[i].s0, points[i].s1}, to[2] = {goal.s0, goal.s1};
    return exit_parameter(from, to, DOMAIN) > 1 ? goal : points[i];
}

/* Where generator i goes that has no partner, and lies between two pairs: away from the wall. */
inline REAL2 pushed_away(int i, int n, int size, global const int *slots, global const int *partners,
                         global const int *convex_starts, global const int *convex_neighbors,
                         global const REAL2 *points, global const REAL *h, DOMAIN_ARGS)
{
    REAL2 away = 0;
    int pairs = 0;
    for (int k = convex_starts[i]; k < convex_starts[i + 1]; ++k) {
        const int j = convex_neighbors[k];
        REAL2 image;
        REAL share;
        if (j < 0 || j >= n || slots[j] >= size || partners[slots[j]] < 0 ||
            !image_across(points[i], points[j], fmin(h[i], h[j]), &image, &share, DOMAIN))
            continue;
        away += share * (image - points[j]) / sqrt(dot(image - points[j], image - points[j]));
        ++pairs;
    }
    if (pairs < 2)
        return points[i];
    const REAL2 goal = points[i] + PUSH * h[i] / pairs * away;
    const REAL from[2] = {points[i].s0, points[i].s1}, to[2] = {goal.s0, goal.s1};
    return exit_parameter(from, to, DOMAIN) > 1 ? goal : points[i];
}

/* targets[2 p], [2 p + 1] = where cell p of those at the wall and its partner go. */
kernel void place_pairs(const int size, global const int *cells, const int n, global const int *slots,
                        global const int *partners, global const int *convex_starts, global const int *convex_neighbors,
                        global const REAL2 *points, global const REAL *h, global const int *labels, const int fixed,
                        DOMAIN_ARGS, global REAL2 *targets)
{
    WORK_ITEM(p);
    const int i = cells[p], j = partners[p];
    if (i >= n)
        return;
    if (j < 0) {
        targets[2 * p] = labels[i] < fixed ? points[i]
                                           : pushed_away(i, n, size, slots, partners, convex_starts, convex_neighbors,
                                                         points, h, DOMAIN);
        return;
    }
    targets[2 * p] = halfway_to_image(i, j, points, h, DOMAIN);
    targets[2 * p + 1] = halfway_to_image(j, i, points, h, DOMAIN);
}

inline void move_paired(int i, REAL2 target, global REAL2 *points, global REAL2 *velocity)
{
    velocity[i] += target - points[i];
    points[i] = target;
}

/* Move the generators of pairs. Cell p moves its partner if that is not at the wall itself; slots[i] is the place of
   cell i among those at the wall. Only the first n generators move: the others are ghosts. */
kernel void move_pairs(const int size, global const int *cells, const int n, global const int *slots,
                       global const int *partners, global const REAL2 *targets, global REAL2 *points,
                       global REAL2 *velocity)
{
    WORK_ITEM(p);
    const int i = cells[p], j = partners[p];
    if (i < n)
        move_paired(i, targets[2 * p], points, velocity);
    if (j >= 0 && j < n && slots[j] >= size)
        move_paired(j, targets[2 * p + 1], points, velocity);
}
