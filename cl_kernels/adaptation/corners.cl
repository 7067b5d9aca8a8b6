/* Faces that end in the re-entrant corners of a polygon. The face between i and j ends in corner c if

       |x_i - c| = |x_j - c| = r,   |x_k - c| > r for all others that see c

   and all cells at c are convex if consecutive faces and walls at c are less than 180 degrees apart.

   corners[c]  position
   shapes[c]   direction of the wall that begins in c, interior angle, h, extent of the corner
   Group g has the corners group_starts[g] .. group_starts[g + 1]; only they may share generators.

   CANDIDATE_REACH  largest distance over h of a generator from a corner that it may share */
#include "geometry/edges.h"

#define PI R(3.14159265358979323846)
#define MOST_CANDIDATES 96
/* Nearest generators that a corner considers, and most sweeps over a group. */
#define NEAREST 6
#define SWEEPS 60
/* Least distance of the others over that of the generators that share the corner, and their largest step over h. */
#define OTHERS R(1.3)
#define OTHERS_STEP R(0.15)
/* Least distance over h of a generator from its corner. */
#define LEAST_RADIUS R(0.3)
/* Least distance over h of a generator that moves from the others. */
#define SEPARATION R(0.1)
/* Margin to straight angles; interior angle above which at least three cells share the corner; largest turn in one
   step. */
#define MARGIN R(0.15)
#define THREE R(5.8)
#define MOST_TURN R(0.15)
/* Angles of cells at the corner beyond which another choice of generators is better, and their weight. */
#define NARROW R(1.3)
#define WIDE R(2.5)
#define SHAPE_WEIGHT R(0.3)

inline REAL gap_between(REAL2 a, REAL2 b)
{
    const REAL2 d = a - b;
    return sqrt(dot(d, d));
}

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

inline bool is_at(REAL2 a, REAL2 b)
{
    return a.s0 == b.s0 && a.s1 == b.s1;
}

/* x turned about the corner by an angle. */
inline REAL2 turned(REAL2 x, REAL2 corner, REAL angle)
{
    const REAL2 v = x - corner;
    const REAL c = cos(angle), s = sin(angle);
    return corner + (REAL2)(c * v.s0 - s * v.s1, s * v.s0 + c * v.s1);
}

/* Whether i is in the list. */
inline bool is_listed(int i, const int *list, int count)
{
    bool found = false;
    for (int p = 0; p < count; ++p)
        found = found || list[p] == i;
    return found;
}

/* Whether candidate p shares one of the corners of the group. */
inline bool is_shared(int p, int corner_count, const int *masks, const int *near, const int *found)
{
    bool shares = false;
    for (int c = 0; c < corner_count; ++c)
        for (int k = 0; k < found[c]; ++k)
            shares = shares || ((masks[c] >> k & 1) && near[c * NEAREST + k] == p);
    return shares;
}

/* Cost of a choice (bits of `mask`) among generators at distances d and angles a from the first wall, in the order of
   angles: squares of the displacements, and of the angles by which cells are too wide. */
inline REAL choice_cost(int mask, int count, const REAL *d, const REAL *a, REAL angle)
{
    const REAL margin = fmin(MARGIN, (2 * PI - angle) / 4 + R(0.01)), widest = PI - margin;
    REAL r = 0;
    int sharing = 0;
    for (int p = 0; p < count; ++p)
        if (mask >> p & 1) {
            r += d[p];
            ++sharing;
        }
    r /= sharing;
    REAL cost = 0, begin = 0, last = -1, lowest = -1;
    for (int p = 0; p <= count; ++p) {
        const bool chosen = p < count && (mask >> p & 1);
        if (p < count) {
            const REAL off = chosen ? d[p] - r : fmax(OTHERS * r - d[p], R(0));
            cost += off * off;
        }
        if (p < count && !chosen)
            continue;
        if (last >= 0 || p == count) {
            const REAL end = p == count ? angle : (last + a[p]) / 2;
            const REAL width = end - begin, over = fmax(width - widest, R(0));
            const REAL off = fmax(width - WIDE, NARROW - width);
            cost += r * r * (4 * over * over + (off > 0 ? SHAPE_WEIGHT * off * off : 0));
            begin = end;
        }
        if (p < count) {
            last = a[p];
            lowest = lowest < 0 ? last : lowest;
        }
    }
    const REAL mean = (lowest + last) / 2, over = mean - clamp(mean, angle - widest, widest);
    return cost + 4 * r * r * over * over;
}

/* Whether the generators that share corner b (bits of mask_b in list_b) and those that share corner c can have equal
   distances from both: at most two have the same distances from two points, one on each side of the line through them.
   */
inline bool may_share_both(int mask_b, const int *list_b, int count_b, REAL2 b, int mask_c, const int *list_c,
                           int count_c, REAL2 c, const int *cells, global const REAL2 *points)
{
    int left = 0, right = 0;
    for (int p = 0; p < count_b; ++p)
        for (int q = 0; q < count_c; ++q)
            if ((mask_b >> p & 1) && (mask_c >> q & 1) && list_b[p] == list_c[q]) {
                const REAL2 e = c - b, v = points[cells[list_c[q]]] - b;
                if (e.s0 * v.s1 - e.s1 * v.s0 > 0)
                    ++left;
                else
                    ++right;
            }
    return left < 2 && right < 2;
}

/* Per group: choose the generators that share each corner, the nearest one that sees it and others, and move them to
   their mean distance from it; move others away. A generator belongs to the group of its nearest corner. moved[] and
   targets[] are the generators of the group that move, -1 for none, and their positions. */
kernel void share_corners(const int size, global const int *starts, global const int *neighbors, const int n,
                          global const REAL2 *points, global const int *labels, const int fixed,
                          global const int *group_starts, global const REAL2 *corners, global const REAL4 *shapes,
                          global const int *other_starts, global const int *others, global const int *seeds,
                          DOMAIN_ARGS, global int *moved, global REAL2 *targets)
{
    WORK_ITEM(g);
    const int first = group_starts[g], corner_count = group_starts[g + 1] - first;
    int cells[MOST_CANDIDATES];
    REAL2 at[MOST_CANDIDATES];
    int count = 0;
    for (int p = 0; p < MOST_MOVED; ++p)
        moved[g * MOST_MOVED + p] = -1;
    for (int c = 0; c < corner_count; ++c) {
        const int i = seeds[first + c];
        if (i < n && !is_listed(i, cells, count))
            cells[count++] = i;
    }
    for (int p = 0; p < count; ++p)
        for (int k = starts[cells[p]]; k < starts[cells[p] + 1]; ++k) {
            const int j = neighbors[k];
            bool near = false;
            for (int c = first; c < first + corner_count && j >= 0; ++c)
                near = near || gap_between(points[j], corners[c]) < R(CANDIDATE_REACH) * shapes[c].s2;
            if (near && count < MOST_CANDIDATES && !is_listed(j, cells, count))
                cells[count++] = j;
        }
    /* Keep those that belong to this group and may move. */
    int kept = 0;
    for (int p = 0; p < count; ++p) {
        const int i = cells[p];
        REAL own = REAL_MAX;
        for (int c = first; c < first + corner_count; ++c)
            own = fmin(own, gap_between(points[i], corners[c]));
        bool mine = labels[i] >= fixed;
        for (int k = other_starts[g]; k < other_starts[g + 1]; ++k) {
            const REAL d = gap_between(points[i], corners[others[k]]);
            mine = mine && !(d < own || (d == own && others[k] < first));
        }
        if (mine)
            cells[kept++] = i;
    }
    count = kept;

    int near[MOST_IN_GROUP * NEAREST], found[MOST_IN_GROUP], masks[MOST_IN_GROUP];
    REAL angles[MOST_IN_GROUP * NEAREST];
    for (int c = 0; c < corner_count; ++c) {
        const REAL2 corner = corners[first + c];
        const REAL4 shape = shapes[first + c];
        int *list = near + c * NEAREST;
        REAL *a = angles + c * NEAREST;
        REAL d[NEAREST];
        int seen = 0;
        REAL last = -1;
        int last_place = -1;
        while (seen < NEAREST) {
            /* The next one by distance; of equal ones the first in the list. */
            REAL best = REAL_MAX;
            int next = -1;
            for (int p = 0; p < count; ++p) {
                const REAL far = gap_between(points[cells[p]], corner);
                if ((far > last || (far == last && p > last_place)) && far < best) {
                    best = far;
                    next = p;
                }
            }
            if (next < 0 || best > R(CANDIDATE_REACH) * shape.s2)
                break;
            last = best;
            last_place = next;
            const REAL2 x = points[cells[next]];
            const REAL from[2] = {x.s0, x.s1}, to[2] = {corner.s0, corner.s1};
            int edge;
            const REAL t = exit_over_edge(from, to, &edge, DOMAIN);
            /* The two walls of the corner do not hide it, but by round-off the path may cross them. */
            const bool ends_here = t <= 1 && (is_at(edge_ends[edge].s01, corner) || is_at(edge_ends[edge].s23, corner));
            if (!ends_here && (1 - t) * best > R(1.01) * shape.s3 + 64 * REAL_EPS)
                continue;
            /* Angle from the first wall; round-off, and the extent of the corner, may put it outside. */
            REAL angle = atan2(x.s1 - corner.s1, x.s0 - corner.s0) - shape.s0;
            angle -= 2 * PI * floor(angle / (2 * PI));
            if (angle > shape.s1)
                angle = angle > (shape.s1 + 2 * PI) / 2 ? 0 : shape.s1;
            /* Sort by angle. */
            int place = seen++;
            for (; place > 0 && a[place - 1] > angle; --place) {
                a[place] = a[place - 1];
                d[place] = d[place - 1];
                list[place] = list[place - 1];
            }
            a[place] = angle;
            d[place] = best;
            list[place] = next;
        }
        found[c] = seen;
        masks[c] = 0;
        int closest = 0;
        for (int p = 1; p < seen; ++p)
            closest = d[p] < d[closest] ? p : closest;
        REAL least = REAL_MAX;
        for (int mask = 3; mask < 1 << seen; ++mask) {
            const int sharing = popcount(mask);
            if (!(mask >> closest & 1) || sharing < (shape.s1 > THREE ? 3 : 2) || sharing > (shape.s1 > THREE ? 4 : 3))
                continue;
            bool possible = true;
            for (int b = 0; b < c; ++b)
                possible = possible && may_share_both(masks[b], near + b * NEAREST, found[b], corners[first + b], mask,
                                                      list, seen, corner, cells, points);
            if (!possible)
                continue;
            const REAL cost = choice_cost(mask, seen, d, a, shape.s1);
            if (cost < least) {
                least = cost;
                masks[c] = mask;
            }
        }
    }

    /* First with mean distances. If that moves a generator outside or too close to another, with the least ones. */
    bool inside = false;
    for (int attempt = 0; attempt < 2 && !inside; ++attempt) {
        for (int p = 0; p < count; ++p)
            at[p] = points[cells[p]];
        for (int c = 0; c < corner_count && attempt == 0; ++c) {
            const REAL2 corner = corners[first + c];
            const REAL angle = shapes[first + c].s1;
            const REAL margin = fmin(MARGIN, (2 * PI - angle) / 4);
            if (masks[c] == 0)
                continue;
            /* Turn all, so that the bisector of the first and the last one lies behind the walls: neither has a part of
               its cell on the other side of a sharp corner. */
            int outer[2] = {-1, -1};
            for (int p = 0; p < found[c]; ++p)
                if (masks[c] >> p & 1) {
                    outer[0] = outer[0] < 0 ? c * NEAREST + p : outer[0];
                    outer[1] = c * NEAREST + p;
                }
            const REAL mean = (angles[outer[0]] + angles[outer[1]]) / 2;
            const REAL back = clamp(mean, angle - PI + margin, PI - margin) - mean;
            if (back != 0)
                for (int p = outer[0]; p <= outer[1]; ++p)
                    if (masks[c] >> (p - c * NEAREST) & 1) {
                        angles[p] += clamp(back, -MOST_TURN, MOST_TURN);
                        at[near[p]] = turned(at[near[p]], corner, clamp(back, -MOST_TURN, MOST_TURN));
                    }
            /* Turn the generators of the first and the last face, so that cells beside the walls are convex. */
            for (int side = 0; side < 2; ++side) {
                int pair[2], picked = 0;
                for (int p = 0; p < found[c] && picked < 2; ++p) {
                    const int q = side ? found[c] - 1 - p : p;
                    if (masks[c] >> q & 1)
                        pair[picked++] = c * NEAREST + q;
                }
                const REAL face = (angles[pair[0]] + angles[pair[1]]) / 2;
                const REAL width = side ? angle - face : face;
                REAL turn = fmin(fmax(width - (PI - margin), R(0)), MOST_TURN);
                if (turn == 0)
                    continue;
                turn = side ? turn : -turn;
                for (int k = 0; k < 2; ++k) {
                    at[near[pair[k]]] = turned(at[near[pair[k]]], corner, turn);
                    angles[pair[k]] += turn;
                }
            }
        }
        REAL change = REAL_MAX;
        for (int sweep = 0; sweep < SWEEPS && change > 2 * REAL_EPS; ++sweep) {
            change = 0;
            for (int c = 0; c < corner_count; ++c) {
                if (masks[c] == 0)
                    continue;
                const REAL2 corner = corners[first + c];
                REAL r = 0, least = REAL_MAX;
                for (int p = 0; p < found[c]; ++p)
                    if (masks[c] >> p & 1) {
                        const REAL d = gap_between(at[near[c * NEAREST + p]], corner);
                        r += d;
                        least = fmin(least, d);
                    }
                r = fmax(attempt ? least : r / popcount(masks[c]), LEAST_RADIUS * shapes[first + c].s2);
                for (int p = 0; p < found[c]; ++p)
                    if (masks[c] >> p & 1) {
                        const int q = near[c * NEAREST + p];
                        const REAL d = gap_between(at[q], corner);
                        if (fabs(d - r) > REAL_EPS / 2 && d > R(0.1) * r)
                            at[q] = corner + (at[q] - corner) * (r / d);
                        change = fmax(change, fabs(d - r));
                    }
            }
        }
        /* Generators that share no corner of the group stay away from its corners. */
        for (int c = 0; c < corner_count; ++c) {
            if (masks[c] == 0)
                continue;
            const REAL2 corner = corners[first + c];
            REAL r = 0;
            for (int p = 0; p < found[c]; ++p)
                if (masks[c] >> p & 1)
                    r = fmax(r, gap_between(at[near[c * NEAREST + p]], corner));
            for (int p = 0; p < found[c]; ++p) {
                const int q = near[c * NEAREST + p];
                const REAL d = gap_between(at[q], corner);
                if (!is_shared(q, corner_count, masks, near, found) && d < OTHERS * r && d > 0)
                    at[q] = corner + (at[q] - corner) * (fmin(OTHERS * r, d + OTHERS_STEP * shapes[first + c].s2) / d);
            }
        }
        inside = true;
        for (int p = 0; p < count; ++p) {
            const REAL2 x = points[cells[p]];
            if (is_at(x, at[p]))
                continue;
            const REAL from[2] = {x.s0, x.s1}, to[2] = {at[p].s0, at[p].s1};
            int edge;
            bool good = exit_over_edge(from, to, &edge, DOMAIN) > 1;
            for (int q = 0; q < count; ++q)
                good = good && (q == p || gap_between(at[p], at[q]) > SEPARATION * shapes[first].s2);
            if (!good) {
                inside = inside && !is_shared(p, corner_count, masks, near, found);
                at[p] = x;
            }
        }
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
