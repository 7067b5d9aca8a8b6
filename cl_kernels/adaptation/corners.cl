/* Faces that end in the re-entrant corners of a polygon. The face between i and j ends in corner c if

       |x_i - c| = |x_j - c| = r,   |x_k - c| > r for all others that see c

   and all cells at c are convex if consecutive faces and walls at c are less than 180 degrees apart.

   corners[c]  position
   shapes[c]   direction of the wall that begins in c, interior angle, h, extent of the corner
   Group g has the corners group_starts[g] .. group_starts[g + 1]; only they may share generators.

   In a tip, a convex corner or a narrow bay, the second and the third nearest generator have the same distance from it.

   CANDIDATE_REACH  largest distance over h of a generator from a corner that it may share
   WIDEST_TIP       angle of a tip above which its first generator may have several neighbors without help */
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
/* Least angle over that of a tip between the two generators behind it. */
#define APART R(0.4)

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

/* A corner of a group, and its nearest candidates that see it, in the order of their angles from the first wall. */
typedef struct {
    REAL2 x;
    REAL angle, h, extent, first_wall;
    int count, mask;   /* mask: bits of those that share the corner; 0 if none do */
    int list[NEAREST]; /* their places among the candidates of the group */
    REAL distances[NEAREST], angles[NEAREST];
} Corner;

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

inline bool shares(const Corner *corner, int k)
{
    return corner->mask >> k & 1;
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

/* Whether candidate i belongs to the group: to that of its nearest corner. Corners before `first`, and those after the
   group, are of other groups. */
inline bool is_own(int i, const Corner *group, int corner_count, int first, global const int *others, int other_count,
                   global const REAL2 *corners, global const REAL2 *points)
{
    REAL own = REAL_MAX;
    for (int c = 0; c < corner_count; ++c)
        own = fmin(own, gap_between(points[i], group[c].x));
    bool mine = true;
    for (int k = 0; k < other_count; ++k) {
        const REAL d = gap_between(points[i], corners[others[k]]);
        mine = mine && !(d < own || (d == own && others[k] < first));
    }
    return mine;
}

/* Collects the generators near the corners of a group: the seeds, and neighbor by neighbor. Returns their number. */
inline int collect_candidates(int *cells, const Corner *group, int corner_count, global const int *seeds, int n,
                              global const int *starts, global const int *neighbors, global const REAL2 *points)
{
    int count = 0;
    for (int c = 0; c < corner_count; ++c)
        if (seeds[c] < n && !is_listed(seeds[c], cells, count))
            cells[count++] = seeds[c];
    for (int p = 0; p < count; ++p)
        for (int k = starts[cells[p]]; k < starts[cells[p] + 1]; ++k) {
            const int j = neighbors[k];
            bool near = false;
            for (int c = 0; c < corner_count && j >= 0; ++c)
                near = near || gap_between(points[j], group[c].x) < R(CANDIDATE_REACH) * group[c].h;
            if (near && count < MOST_CANDIDATES && !is_listed(j, cells, count))
                cells[count++] = j;
        }
    return count;
}

/* Whether a wall hides the corner from x, at a distance. The two walls of the corner do not, but by round-off the path
   may cross them. */
inline bool is_hidden(const Corner *corner, REAL2 x, REAL distance, DOMAIN_ARGS)
{
    const REAL from[2] = {x.s0, x.s1}, to[2] = {corner->x.s0, corner->x.s1};
    int edge;
    const REAL t = exit_over_edge(from, to, &edge, DOMAIN);
    const bool ends_here = t <= 1 && (is_at(edge_ends[edge].s01, corner->x) || is_at(edge_ends[edge].s23, corner->x));
    return !ends_here && (1 - t) * distance > R(1.01) * corner->extent + 64 * REAL_EPS;
}

/* Angle of x about the corner from the first wall; round-off, and the extent of the corner, may put it outside. */
inline REAL angle_at(const Corner *corner, REAL2 x)
{
    REAL angle = atan2(x.s1 - corner->x.s1, x.s0 - corner->x.s0) - corner->first_wall;
    angle -= 2 * PI * floor(angle / (2 * PI));
    if (angle > corner->angle)
        angle = angle > (corner->angle + 2 * PI) / 2 ? 0 : corner->angle;
    return angle;
}

/* Lists the nearest candidates that see the corner, by angle. */
inline void list_nearest(Corner *corner, const int *cells, int count, global const REAL2 *points, DOMAIN_ARGS)
{
    REAL last = -1;
    int last_place = -1;
    corner->count = 0;
    while (corner->count < NEAREST) {
        /* The next one by distance; of equal ones the first in the list. */
        REAL best = REAL_MAX;
        int next = -1;
        for (int p = 0; p < count; ++p) {
            const REAL far = gap_between(points[cells[p]], corner->x);
            if ((far > last || (far == last && p > last_place)) && far < best) {
                best = far;
                next = p;
            }
        }
        if (next < 0 || best > R(CANDIDATE_REACH) * corner->h)
            break;
        last = best;
        last_place = next;
        const REAL2 x = points[cells[next]];
        if (is_hidden(corner, x, best, DOMAIN))
            continue;
        const REAL angle = angle_at(corner, x);
        int place = corner->count++;
        for (; place > 0 && corner->angles[place - 1] > angle; --place) {
            corner->angles[place] = corner->angles[place - 1];
            corner->distances[place] = corner->distances[place - 1];
            corner->list[place] = corner->list[place - 1];
        }
        corner->angles[place] = angle;
        corner->distances[place] = best;
        corner->list[place] = next;
    }
}

/* Cost of a choice (bits of `mask`) among the listed generators: squares of the displacements, and of the angles by
   which cells are too wide. */
inline REAL choice_cost(int mask, const Corner *corner)
{
    const int count = corner->count;
    const REAL *d = corner->distances, *a = corner->angles, angle = corner->angle;
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

/* Whether the generators that share corner b and those of `mask` at corner c can have equal distances from both: at
   most two have the same distances from two points, one on each side of the line through them. */
inline bool may_share_both(const Corner *b, const Corner *c, int mask, const int *cells, global const REAL2 *points)
{
    int left = 0, right = 0;
    for (int p = 0; p < b->count; ++p)
        for (int q = 0; q < c->count; ++q)
            if (shares(b, p) && (mask >> q & 1) && b->list[p] == c->list[q]) {
                const REAL2 e = c->x - b->x, v = points[cells[c->list[q]]] - b->x;
                if (e.s0 * v.s1 - e.s1 * v.s0 > 0)
                    ++left;
                else
                    ++right;
            }
    return left < 2 && right < 2;
}

/* Whether the domain ends in a sharp convex corner here, or in a narrow bay. */
inline bool is_tip(const Corner *corner)
{
    return corner->angle < PI;
}

/* Bits of the second and the third nearest generator, which lie side by side in a tip behind the first one; 0 if there
   are fewer, or if the tip is wide and the first one has several neighbors without help. */
inline int choose_behind(const Corner *tip, const int *cells, global const int *starts, global const int *neighbors)
{
    int order[3] = {-1, -1, -1};
    for (int p = 0; p < tip->count; ++p)
        for (int k = 0, q = p; k < 3; ++k)
            if (order[k] < 0 || tip->distances[q] < tip->distances[order[k]]) {
                const int next = order[k];
                order[k] = q;
                q = next;
                if (q < 0)
                    break;
            }
    if (order[2] < 0)
        return 0;
    if (tip->angle > R(WIDEST_TIP)) {
        const int i = cells[tip->list[order[0]]];
        int inner = 0;
        for (int k = starts[i]; k < starts[i + 1]; ++k)
            inner += neighbors[k] >= 0;
        if (inner > 1)
            return 0;
    }
    return 1 << order[1] | 1 << order[2];
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

/* Bits of the generators that share corner c of a group: the nearest one and others, at the least cost; 0 for none.
   The corners before c have chosen. */
inline int choose_shared(const Corner *group, int c, const int *cells, global const REAL2 *points)
{
    const Corner *corner = group + c;
    int closest = 0, chosen = 0;
    for (int p = 1; p < corner->count; ++p)
        closest = corner->distances[p] < corner->distances[closest] ? p : closest;
    const int fewest = corner->angle > THREE ? 3 : 2;
    REAL least = REAL_MAX;
    for (int mask = 3; mask < 1 << corner->count; ++mask) {
        const int sharing = popcount(mask);
        if (!(mask >> closest & 1) || sharing < fewest || sharing > fewest + 1)
            continue;
        bool possible = true;
        for (int b = 0; b < c; ++b)
            possible = possible && may_share_both(group + b, corner, mask, cells, points);
        if (!possible)
            continue;
        const REAL cost = choice_cost(mask, corner);
        if (cost < least) {
            least = cost;
            chosen = mask;
        }
    }
    return chosen;
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
