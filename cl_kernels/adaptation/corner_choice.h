/* The choice of the generators that share a corner, among the nearest ones that see it.

   CANDIDATE_REACH  largest distance over h of a generator from a corner that it may share
   FARTHEST_REACH   the same where no generator is near: cells are larger than h at the corner
   WIDEST_TIP       angle of a tip above which its first generator may have several neighbors without help */
#include "geometry/edges.h"

#define PI R(3.14159265358979323846)
#define MOST_CANDIDATES 96
/* Nearest generators that a corner considers. */
#define NEAREST 6
/* Least distance of the others over that of the generators that share the corner. */
#define OTHERS R(1.3)
/* Least reach of a corner over the distance of the nearest generator at its walls. */
#define BEYOND_NEAREST R(1.3)
/* Margin to straight angles; interior angle above which at least three cells share the corner. */
#define MARGIN R(0.15)
#define THREE R(5.8)
/* Angles of cells at the corner beyond which another choice of generators is better, and their weight. */
#define NARROW R(1.3)
#define WIDE R(2.5)
#define SHAPE_WEIGHT R(0.3)

inline REAL gap_between(REAL2 a, REAL2 b)
{
    const REAL2 d = a - b;
    return sqrt(dot(d, d));
}

/* A corner of a group, and its nearest candidates that see it, in the order of their angles from the first wall. */
typedef struct {
    REAL2 x;
    REAL angle, h, extent, first_wall, reach;
    int count, mask;   /* mask: bits of those that share the corner; 0 if none do */
    int list[NEAREST]; /* their places among the candidates of the group */
    REAL distances[NEAREST], angles[NEAREST];
} Corner;

inline bool is_at(REAL2 a, REAL2 b)
{
    return a.s0 == b.s0 && a.s1 == b.s1;
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
                near = near || gap_between(points[j], group[c].x) < group[c].reach;
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
        if (next < 0 || best > corner->reach)
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
