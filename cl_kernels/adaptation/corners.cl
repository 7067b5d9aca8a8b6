/* Faces that end in the re-entrant corners of a polygon. The face between i and j ends in corner c if

       |x_i - c| = |x_j - c| = r,   |x_k - c| > r for all others that see c

   and all cells at c are convex if consecutive faces and walls at c are less than 180 degrees apart.

   corners[c]  position
   shapes[c]   direction of the wall that begins in c, interior angle, h, extent of the corner
   Group g has the corners group_starts[g] .. group_starts[g + 1]; only they may share generators.

   In a tip, a convex corner or a narrow bay, the second and the third nearest generator are equally far from it. */
#include "adaptation/corner_choice.h"

/* Most sweeps over a group. */
#define SWEEPS 60
/* Largest step over h of a generator that shares no corner. */
#define OTHERS_STEP R(0.15)
/* Least distance over h of a generator from its corner. */
#define LEAST_RADIUS R(0.3)
/* Least distance over h of a generator that moves from the others. */
#define SEPARATION R(0.1)
/* Largest turn in one step. */
#define MOST_TURN R(0.15)
/* Least angle over that of a tip between the two generators behind it. */
#define APART R(0.4)

/* Without find_cells: nearest[c] = least distance of a cell at the wall from corner c, as the bits of a float. With it:
   seeds[c] = the first cell at that distance; the search for candidates starts there. `cells` are those that the
   boundary crosses. */
kernel void find_seeds(const int size, const int find_cells, global const int *cells, const int n,
                       global const int *starts, global const int *neighbors, global const REAL2 *points,
                       global const int2 *wall_corners, global const REAL2 *corners, global int *nearest,
                       global int *seeds)
{
    WORK_ITEM(p);
    const int i = cells[p];
    if (i >= n)
        return;
    for (int k = starts[i]; k < starts[i + 1]; ++k) {
        if (neighbors[k] >= 0)
            continue;
        const int2 near = wall_corners[-1 - neighbors[k]];
        for (int side = 0; side < 2; ++side) {
            const int c = side ? near.s1 : near.s0;
            if (c < 0)
                continue;
            const int gap = as_int((float)gap_between(points[i], corners[c]));
            if (!find_cells)
                atomic_min(nearest + c, gap);
            else if (nearest[c] == gap)
                atomic_min(seeds + c, i);
        }
    }
}

/* x turned about the corner by an angle. */
inline REAL2 turned(REAL2 x, REAL2 corner, REAL angle)
{
    const REAL2 v = x - corner;
    const REAL c = cos(angle), s = sin(angle);
    return corner + (REAL2)(c * v.s0 - s * v.s1, s * v.s0 + c * v.s1);
}

/* Whether candidate p shares one of the corners of the group. */
inline bool is_shared(int p, const Corner *group, int corner_count)
{
    bool shared = false;
    for (int c = 0; c < corner_count; ++c)
        for (int k = 0; k < group[c].count; ++k)
            shared = shared || (shares(group + c, k) && group[c].list[k] == p);
    return shared;
}

/* Turns the two generators behind a tip apart, if they are one behind the other. */
inline void turn_apart(Corner *tip, REAL2 *at)
{
    int pair[2], picked = 0;
    for (int p = 0; p < tip->count; ++p)
        if (shares(tip, p))
            pair[picked++] = p;
    const REAL width = tip->angles[pair[1]] - tip->angles[pair[0]];
    const REAL turn = clamp((APART * tip->angle - width) / 2, R(0), MOST_TURN / 2);
    for (int k = 0; k < 2; ++k) {
        const int q = tip->list[pair[k]];
        at[q] = turned(at[q], tip->x, k ? turn : -turn);
    }
}

/* Turns the generators that share a corner about it. First all, so that the bisector of the first and the last one lies
   behind the walls: neither has a part of its cell on the other side of a sharp corner. Then those of the first and of
   the last face, so that cells beside the walls are convex. */
inline void turn_shared(Corner *corner, REAL2 *at)
{
    if (is_tip(corner)) {
        turn_apart(corner, at);
        return;
    }
    const REAL angle = corner->angle, margin = fmin(MARGIN, (2 * PI - angle) / 4);
    REAL *angles = corner->angles;
    int first = -1, last = -1;
    for (int p = 0; p < corner->count; ++p)
        if (shares(corner, p)) {
            first = first < 0 ? p : first;
            last = p;
        }
    const REAL mean = (angles[first] + angles[last]) / 2;
    const REAL back = clamp(mean, angle - PI + margin, PI - margin) - mean;
    if (back != 0)
        for (int p = first; p <= last; ++p)
            if (shares(corner, p)) {
                const REAL turn = clamp(back, -MOST_TURN, MOST_TURN);
                angles[p] += turn;
                at[corner->list[p]] = turned(at[corner->list[p]], corner->x, turn);
            }
    for (int side = 0; side < 2; ++side) {
        int pair[2], picked = 0;
        for (int p = 0; p < corner->count && picked < 2; ++p) {
            const int q = side ? corner->count - 1 - p : p;
            if (shares(corner, q))
                pair[picked++] = q;
        }
        const REAL face = (angles[pair[0]] + angles[pair[1]]) / 2;
        const REAL width = side ? angle - face : face;
        REAL turn = fmin(fmax(width - (PI - margin), R(0)), MOST_TURN);
        if (turn == 0)
            continue;
        turn = side ? turn : -turn;
        for (int k = 0; k < 2; ++k) {
            const int q = corner->list[pair[k]];
            at[q] = turned(at[q], corner->x, turn);
            angles[pair[k]] += turn;
        }
    }
}

/* Moves the generators that share a corner to their mean, or least, distance from it; returns the largest difference.
 */
inline REAL equalize_distances(const Corner *corner, bool to_least, REAL2 *at)
{
    REAL r = 0, least = REAL_MAX, change = 0;
    for (int p = 0; p < corner->count; ++p)
        if (shares(corner, p)) {
            const REAL d = gap_between(at[corner->list[p]], corner->x);
            r += d;
            least = fmin(least, d);
        }
    r = fmax(to_least ? least : r / popcount(corner->mask), LEAST_RADIUS * corner->h);
    for (int p = 0; p < corner->count; ++p)
        if (shares(corner, p)) {
            const int q = corner->list[p];
            const REAL d = gap_between(at[q], corner->x);
            if (fabs(d - r) > REAL_EPS / 2 && d > R(0.1) * r)
                at[q] = corner->x + (at[q] - corner->x) * (r / d);
            change = fmax(change, fabs(d - r));
        }
    return change;
}

/* Moves generators that share no corner of the group away from corner c. */
inline void move_others_away(const Corner *group, int corner_count, int c, REAL2 *at)
{
    const Corner *corner = group + c;
    if (is_tip(corner))
        return;
    REAL r = 0;
    for (int p = 0; p < corner->count; ++p)
        if (shares(corner, p))
            r = fmax(r, gap_between(at[corner->list[p]], corner->x));
    for (int p = 0; p < corner->count; ++p) {
        const int q = corner->list[p];
        const REAL d = gap_between(at[q], corner->x);
        if (!is_shared(q, group, corner_count) && d < OTHERS * r && d > 0)
            at[q] = corner->x + (at[q] - corner->x) * (fmin(OTHERS * r, d + OTHERS_STEP * corner->h) / d);
    }
}

/* Puts back the generators that have moved outside, or too close to another; returns whether none of them shares a
   corner. */
inline bool put_back(const Corner *group, int corner_count, const int *cells, int count, global const REAL2 *points,
                     REAL2 *at, DOMAIN_ARGS)
{
    bool all_good = true;
    for (int p = 0; p < count; ++p) {
        const REAL2 x = points[cells[p]];
        if (is_at(x, at[p]))
            continue;
        const REAL from[2] = {x.s0, x.s1}, to[2] = {at[p].s0, at[p].s1};
        bool good = exit_parameter(from, to, DOMAIN) > 1;
        for (int q = 0; q < count; ++q)
            good = good && (q == p || gap_between(at[p], at[q]) > SEPARATION * group[0].h);
        if (!good) {
            all_good = all_good && !is_shared(p, group, corner_count);
            at[p] = x;
        }
    }
    return all_good;
}

/* Per group: choose the generators that share each corner, the nearest one that sees it and others, and move them to
   their mean distance from it; move others away. moved[] and targets[] are the generators of the group that move, -1
   for none, and their positions. */
kernel void share_corners(const int size, global const int *starts, global const int *neighbors, const int n,
                          global const REAL2 *points, global const int *labels, const int fixed,
                          global const int *group_starts, global const REAL2 *corners, global const REAL4 *shapes,
                          global const int *other_starts, global const int *others, global const int *seeds,
                          DOMAIN_ARGS, global int *moved, global REAL2 *targets)
{
    WORK_ITEM(g);
    const int first = group_starts[g], corner_count = group_starts[g + 1] - first;
    Corner group[MOST_IN_GROUP];
    int cells[MOST_CANDIDATES];
    REAL2 at[MOST_CANDIDATES];
    for (int p = 0; p < MOST_MOVED; ++p)
        moved[g * MOST_MOVED + p] = -1;
    for (int c = 0; c < corner_count; ++c) {
        const REAL4 shape = shapes[first + c];
        group[c].x = corners[first + c];
        group[c].first_wall = shape.s0;
        group[c].angle = shape.s1;
        group[c].h = shape.s2;
        group[c].extent = shape.s3;
        const int seed = seeds[first + c];
        const REAL nearest = seed < n ? gap_between(points[seed], group[c].x) : 0;
        group[c].reach =
            fmin(fmax(R(CANDIDATE_REACH) * shape.s2, BEYOND_NEAREST * nearest), R(FARTHEST_REACH) * shape.s2);
    }
    const int found = collect_candidates(cells, group, corner_count, seeds + first, n, starts, neighbors, points);
    /* Keep those that belong to this group and may move. */
    int count = 0;
    for (int p = 0; p < found; ++p)
        if (labels[cells[p]] >= fixed && is_own(cells[p], group, corner_count, first, others + other_starts[g],
                                                other_starts[g + 1] - other_starts[g], corners, points))
            cells[count++] = cells[p];
    for (int c = 0; c < corner_count; ++c) {
        list_nearest(group + c, cells, count, points, DOMAIN);
        group[c].mask = is_tip(group + c) ? choose_behind(group + c, cells, starts, neighbors)
                                          : choose_shared(group, c, cells, points);
    }
    /* First with mean distances. If that moves a generator outside or too close to another, with the least ones. */
    bool done = false;
    for (int attempt = 0; attempt < 2 && !done; ++attempt) {
        for (int p = 0; p < count; ++p)
            at[p] = points[cells[p]];
        for (int c = 0; c < corner_count && attempt == 0; ++c)
            if (group[c].mask)
                turn_shared(group + c, at);
        REAL change = REAL_MAX;
        for (int sweep = 0; sweep < SWEEPS && change > 2 * REAL_EPS; ++sweep) {
            change = 0;
            for (int c = 0; c < corner_count; ++c)
                if (group[c].mask)
                    change = fmax(change, equalize_distances(group + c, attempt > 0, at));
        }
        for (int c = 0; c < corner_count; ++c)
            if (group[c].mask)
                move_others_away(group, corner_count, c, at);
        done = put_back(group, corner_count, cells, count, points, at, DOMAIN);
    }
    int written = 0;
    for (int p = 0; p < count; ++p) {
        if (!is_at(points[cells[p]], at[p]) && written < MOST_MOVED) {
            moved[g * MOST_MOVED + written] = cells[p];
            targets[g * MOST_MOVED + written] = at[p];
            ++written;
        }
    }
}

/* Move each generator to its target. No two groups move the same one. */
kernel void move_to_corners(const int size, global const int *moved, global const REAL2 *targets, global REAL2 *points,
                            global REAL2 *velocity)
{
    WORK_ITEM(p);
    const int i = moved[p];
    if (i < 0)
        return;
    velocity[i] += targets[p] - points[i];
    points[i] = targets[p];
}
