/* Clipping a polyhedron by a team; see clip.h. In Ray et al., Meshless Voronoi on the GPU (2018), a cell is the work of
   one thread.

   Here a member does the vertices `lane` and `lane + 32`, or an edge of the rim, or a face. The numbers of all vertices
   and faces are those of clip.h: a set is a word, and the number of its members before a member is a popcount. So a
   cell has the same bits. */
#include "tessellation/team.h"
#include "tessellation/polyhedron_search.h"

/* What a team has in local memory. */
typedef struct {
    cell_t cell;
    REAL4 ways[TEAM];              /* of the next items: the vectors to them, and their squares */
    int labels[TEAM];              /* and their generators */
    int places[BATCH];             /* items that may cut the cell */
    uchar sorted[BATCH];           /* their numbers, the nearest first */
    uchar shells[BATCH];           /* of each, its shell */
    int starts[SHELLS];            /* of the shells in `sorted`; later, a vertex of each face */
    uchar vacant[VERTEX_CAPACITY]; /* removed vertices */
    uint words[3 + TEAM];          /* see team_t */
} shared_t;

/* What each member knows of the cell, in place of the fields of `cell_t`. */
typedef struct {
    int n;
    uint alive;
    bool torn;
    REAL reach2;
} known_t;

/* Whether vertex v is in the set of two words. */
inline bool in_masks(uint a, uint b, int v)
{
    return ((v < 32 ? a : b) >> (v & 31)) & 1;
}

/* List the edges of the rim from vertex v, from number `place` on: to those of its neighbors that stay. */
inline void list_rim_edges(local rim_t *rim, int v, INDEX4 f, INDEX4 links, bool first, bool second, bool third,
                           int place)
{
    if (first) {
        rim->edges[place] = (INDEX4)(f.s0, f.s1, links.s0, v);
        rim->edge_after[f.s0] = place++;
    }
    if (second) {
        rim->edges[place] = (INDEX4)(f.s1, f.s2, links.s1, v);
        rim->edge_after[f.s1] = place++;
    }
    if (third) {
        rim->edges[place] = (INDEX4)(f.s2, f.s0, links.s2, v);
        rim->edge_after[f.s2] = place;
    }
}

/* Find the rim around the vertices beyond the bisector, and the faces that are `dead`; see find_rim. Returns the number
   of edges, or -1 if it is not one simple cycle. */
inline int team_rim(local shared_t *at, team_t *team, uint gone_a, uint gone_b, uint *dead)
{
    local cell_t *cell = &at->cell;
    const int lane = team->lane;
    const uint below = BELOW(lane);
    const int gone = popcount(gone_a) + popcount(gone_b);
    const bool ga = (gone_a >> lane) & 1, gb = (gone_b >> lane) & 1;
    const INDEX4 f = cell->faces[lane], links = cell->links[lane];
    const bool a0 = ga && !in_masks(gone_a, gone_b, links.s0), a1 = ga && !in_masks(gone_a, gone_b, links.s1),
               a2 = ga && !in_masks(gone_a, gone_b, links.s2);
    const uint m0 = team_ballot(team, a0), m1 = team_ballot(team, a1), m2 = team_ballot(team, a2);
    int place = popcount(m0 & below) + popcount(m1 & below) + popcount(m2 & below);
    int n = popcount(m0) + popcount(m1) + popcount(m2);
    uint touched = 0, around = 0;
    if (ga) {
        touched = (uint)1 << f.s0 | (uint)1 << f.s1 | (uint)1 << f.s2;
        around = (uint)a0 << f.s0 | (uint)a1 << f.s1 | (uint)a2 << f.s2;
    }
    INDEX4 g = 0, others = 0; /* of the second vertex */
    bool b0 = false, b1 = false, b2 = false;
    int place_b = n;
    if (gone_b != 0) {
        g = cell->faces[lane + 32];
        others = cell->links[lane + 32];
        b0 = gb && !in_masks(gone_a, gone_b, others.s0);
        b1 = gb && !in_masks(gone_a, gone_b, others.s1);
        b2 = gb && !in_masks(gone_a, gone_b, others.s2);
        const uint k0 = team_ballot(team, b0), k1 = team_ballot(team, b1), k2 = team_ballot(team, b2);
        place_b += popcount(k0 & below) + popcount(k1 & below) + popcount(k2 & below);
        n += popcount(k0) + popcount(k1) + popcount(k2);
        if (gb) {
            touched |= (uint)1 << g.s0 | (uint)1 << g.s1 | (uint)1 << g.s2;
            around |= (uint)b0 << g.s0 | (uint)b1 << g.s1 | (uint)b2 << g.s2;
        }
    }
    if (n > FACE_CAPACITY)
        return -1;
    /* Simple cycles and Euler's formula, as in find_rim. */
    touched = team_or(team, touched);
    around = team_or(team, around);
    const uint inner = touched & ~around;
    *dead = inner;
    if ((int)popcount(around) != n || n != gone + 2 - 2 * (int)popcount(inner))
        return -1;
    local rim_t *rim = &cell->rim;
    if (ga) {
        at->vacant[popcount(gone_a & below)] = lane;
        list_rim_edges(rim, lane, f, links, a0, a1, a2, place);
    }
    if (gb) {
        at->vacant[popcount(gone_a) + popcount(gone_b & below)] = lane + 32;
        list_rim_edges(rim, lane + 32, g, others, b0, b1, b2, place_b);
    }
    TEAM_SYNC();
    if (gone > 6) {
        int k = 0, steps = 0;
        do {
            k = rim->edge_after[rim->edges[k].s1];
            ++steps;
        } while (k != 0 && steps <= n);
        return steps == n ? n : -1;
    }
    return n;
}

/* The squared distance of vertex v from the generator. */
inline REAL vertex_square(const CELL *cell, int v)
{
    const REAL x = X(cell)[v], y = Y(cell)[v], z = Z(cell)[v];
    return fma(x, x, fma(y, y, z * z));
}

/* See find_reach. */
inline void team_reach(local shared_t *at, team_t *team, known_t *known)
{
    const int lane = team->lane, n = known->n;
    REAL far = lane < n ? vertex_square(&at->cell, lane) : 0;
    if (n > 32 && lane + 32 < n)
        far = fmax(far, vertex_square(&at->cell, lane + 32));
    known->reach2 = team_largest(team, far);
}

/* Clip the cell by the bisector with generator `label` at x + d; see clip_polyhedron. Returns CLIP_*. */
inline int team_clip(local shared_t *at, team_t *team, known_t *known, REAL4 d, REAL d2, int label, bool seen_before,
                     global const REAL *points)
{
    local cell_t *cell = &at->cell;
    local REAL *x = X(cell), *y = Y(cell), *z = Z(cell), *beyond = BEYOND(cell);
    const int lane = team->lane, n = known->n;
    const bool wide = n > 32;
    const REAL level = d2 / 2;
    REAL sa = fma(x[lane], d.s0, fma(y[lane], d.s1, fma(z[lane], d.s2, -level)));
    sa = lane < n ? sa : -level;
    REAL sb = -level;
    if (wide && lane + 32 < n)
        sb = fma(x[lane + 32], d.s0, fma(y[lane + 32], d.s1, fma(z[lane + 32], d.s2, -level)));
    if (team_ballot(team, fmax(sa, sb) > 4 * REAL_EPS * d2) == 0)
        return CLIP_MISSED;
    const REAL distance = sqrt(d2), depth = distance * noise_length(distance);
    uint gone_a = team_ballot(team, sa > depth), gone_b = wide ? team_ballot(team, sb > depth) : 0;
    if ((gone_a | gone_b) == 0)
        return CLIP_MISSED;
    if (seen_before && team_ballot(team, ((known->alive >> lane) & 1) && cell->labels[lane] == label) != 0)
        return CLIP_MISSED;
    beyond[lane] = sa;
    if (wide)
        beyond[lane + 32] = sb;
    uint dead;
    int edges = team_rim(at, team, gone_a, gone_b, &dead);
    if (edges < 0) { /* rare: one member repairs the disc */
        if ((int)(popcount(gone_a) + popcount(gone_b)) == n)
            return CLIP_COLLAPSED;
        TEAM_SYNC();
        if (lane == 0) {
            const REAL doubt = 64 * distance * (noise_length(distance) + REAL_EPS * sqrt(known->reach2));
            cell->n = n;
            cell->torn = !keep_disc(cell, depth, doubt);
        }
        TEAM_SYNC();
        known->torn |= cell->torn;
        gone_a = team_ballot(team, lane < n && beyond[lane] > depth);
        gone_b = wide ? team_ballot(team, lane + 32 < n && beyond[lane + 32] > depth) : 0;
        edges = team_rim(at, team, gone_a, gone_b, &dead);
        if (edges < 0) {
            known->torn = true;
            return CLIP_COLLAPSED;
        }
    }
    const int gone = popcount(gone_a) + popcount(gone_b);
    if (n - gone + edges > VERTEX_CAPACITY)
        return CLIP_FULL;
    const uint alive = known->alive & ~dead, spare = ~alive;
    if (spare == 0)
        return CLIP_FULL;
    const int face = 31 - (int)clz(spare & -spare);
    known->alive = alive | (uint)1 << face;
    if (lane == 0) {
        cell->labels[face] = label;
        cell->planes[face] = (REAL4)(d.s0, d.s1, d.s2, level);
    }
    /* A new vertex for each edge of the rim, at the place of a removed vertex or after the last one. */
    const bool meet = known->reach2 > 16 * d2; /* see meet_planes */
    if (meet)
        TEAM_SYNC();
    INDEX4 edge = 0;
    REAL4 new = 0;
    if (lane < edges) {
        edge = cell->rim.edges[lane];
        const int in = edge.s2, out = edge.s3;
        const REAL4 from = (REAL4)(x[in], y[in], z[in], 0), to = (REAL4)(x[out], y[out], z[out], 0);
        const REAL s_in = beyond[in] < 0 ? beyond[in] : 0;
        const REAL t = s_in / (s_in - beyond[out]);
        new = from + (to - from) * t;
        if (meet) {
            const REAL reach = distance * sqrt(known->reach2);
            const REAL4 corner = meeting_point(cell, edge.s0, edge.s1, face, points);
            const REAL slack = 1 + reach / (beyond[out] - beyond[in]);
            const REAL off = fabs(corner.s0 - new.s0) + fabs(corner.s1 - new.s1) + fabs(corner.s2 - new.s2);
            const REAL length = fabs(to.s0 - from.s0) + fabs(to.s1 - from.s1) + fabs(to.s2 - from.s2);
            if (slack < 1024 && off < 1024 * REAL_EPS * (length + sqrt(known->reach2)) * slack)
                new = corner;
        }
    }
    const int v = lane < gone ? at->vacant[lane] : n + lane - gone;
    TEAM_SYNC();
    if (lane < edges) {
        x[v] = new.s0;
        y[v] = new.s1;
        z[v] = new.s2;
        cell->rim.edges[lane].s3 = v;
        cell->faces[v] = (INDEX4)(edge.s0, edge.s1, face, 0);
        link_vertex(cell, edge.s2, edge.s1, v);
    }
    TEAM_SYNC();
    /* Compilers write a number of a vector by writing all four: so no two members may write to one at a time. */
    int next = 0;
    if (lane < edges) {
        next = cell->rim.edges[cell->rim.edge_after[edge.s1]].s3;
        cell->links[v] = (INDEX4)(edge.s2, next, 0, 0);
    }
    TEAM_SYNC();
    if (lane < edges)
        cell->links[next].s2 = v;
    TEAM_SYNC();
    if (gone > edges) { /* fill the gaps from the end */
        if (lane == 0) {
            int end = n;
            for (int k = gone - 1; k >= edges; --k) {
                const int to = at->vacant[k], last = --end;
                if (to != last)
                    move_vertex(cell, last, to);
            }
        }
        TEAM_SYNC();
    }
    known->n = n - gone + edges;
    team_reach(at, team, known);
    return CLIP_CUT;
}

/* Start with the whole box around generator x; see start_polyhedron. */
inline void team_start(local shared_t *at, team_t *team, known_t *known, REAL4 x, REAL4 lower, REAL4 upper)
{
    local cell_t *cell = &at->cell;
    const REAL4 low = lower - x, high = upper - x;
    const int v = team->lane;
    if (v < 3)
        at->words[v] = 0;
    if (v < 8)
        start_vertex(cell, v, low, high);
    if (v < 6) {
        const bool above = v & 1;
        const int axis = v >> 1;
        const REAL one = above ? 1 : -1;
        const REAL room = above ? (axis == 0 ? high.s0 : (axis == 1 ? high.s1 : high.s2))
                                : -(axis == 0 ? low.s0 : (axis == 1 ? low.s1 : low.s2));
        cell->labels[v] = -1 - v;
        cell->planes[v] = (REAL4)(axis == 0 ? one : 0, axis == 1 ? one : 0, axis == 2 ? one : 0, room);
    }
    known->n = 8;
    known->alive = 63;
    known->torn = false;
    TEAM_SYNC();
    team_reach(at, team, known);
}
