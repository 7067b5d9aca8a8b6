/* Pairs of generators on both sides of a wall that is thinner than a cell. The diagram is computed without walls: the
   cell of a generator beside a thin wall extends to the other side, and that part is then cut off. This does not happen
   if the generators on both sides are mirror images of each other.

   THIN  largest thickness of a thin wall over h */
#include "geometry/edges.h"

/* Largest distance over h of a generator from the image of the other one, and sine of the largest angle between the two
   sides of the wall. */
#define PAIRED R(0.45)
#define PARALLEL R(0.5)

/* The image of y at the middle of the wall between x and y; false if no thin wall is between them. */
inline bool image_across(REAL2 x, REAL2 y, REAL h, REAL2 *image, DOMAIN_ARGS)
{
    const REAL here[2] = {x.s0, x.s1}, there[2] = {y.s0, y.s1};
    const REAL apart = sqrt(dot(y - x, y - x));
    int edge, other;
    const REAL t = exit_over_edge(here, there, &edge, DOMAIN);
    if (t > 1)
        return false;
    const REAL s = exit_over_edge(there, here, &other, DOMAIN);
    if (s > 1 || (1 - t - s) * apart > R(THIN) * h)
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

/* partners[p] = the generator whose image is nearest to that of cell p of those at the wall, -1 if there is none.
   Both are neighbors in the diagram without walls, but not in the diagram. */
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
    REAL least = PAIRED * h[i];
    for (int k = convex_starts[i]; k < convex_starts[i + 1]; ++k) {
        const int j = convex_neighbors[k];
        if (j < 0 || j >= n || labels[j] < fixed)
            continue;
        bool touches = false;
        for (int m = starts[i]; m < starts[i + 1]; ++m)
            touches = touches || neighbors[m] == j;
        REAL2 image;
        if (touches || !image_across(points[i], points[j], fmin(h[i], h[j]), &image, DOMAIN))
            continue;
        const REAL away = sqrt(dot(image - points[i], image - points[i]));
        if (away < least) {
            least = away;
            partners[p] = j;
        }
    }
}

/* targets[p] = halfway to the image of the partner, if both are partners of each other. slots[i] is the place of cell i
   among those at the wall. */
kernel void place_pairs(const int size, global const int *cells, const int n, global const int *slots,
                        global const int *partners, global const REAL2 *points, global const REAL *h, DOMAIN_ARGS,
                        global REAL2 *targets)
{
    WORK_ITEM(p);
    const int i = cells[p], j = partners[p];
    if (i >= n)
        return;
    REAL2 image = points[i];
    targets[p] = image;
    if (j < 0 || slots[j] >= size || partners[slots[j]] != i ||
        !image_across(points[i], points[j], fmin(h[i], h[j]), &image, DOMAIN))
        return;
    const REAL2 goal = (points[i] + image) / 2;
    const REAL from[2] = {points[i].s0, points[i].s1}, to[2] = {goal.s0, goal.s1};
    int edge;
    if (exit_over_edge(from, to, &edge, DOMAIN) > 1)
        targets[p] = goal;
}

/* Move the generators of pairs. */
kernel void move_pairs(const int size, global const int *cells, const int n, global const REAL2 *targets,
                       global REAL2 *points, global REAL2 *velocity)
{
    WORK_ITEM(p);
    const int i = cells[p];
    if (i >= n)
        return;
    velocity[i] += targets[p] - points[i];
    points[i] = targets[p];
}
