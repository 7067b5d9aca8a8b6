#include "tessellation/team.h"
#include "tessellation/corner_flips.h"

/* A cell in the local memory of its team: a face per member, and two vertices. */
typedef struct {
    corners_t cell;
    union {
        links_t links;
        struct {
            REAL4 shares[3 * TEAM]; /* of TEAM vertices, for their three faces; later, see TERMS */
            REAL seconds[6 * TEAM]; /* of these vertices */
        } sums;
    } work;
    uint vertices[2][TEAM]; /* of each face: its first 32 vertices, and the others */
    uint edges[TEAM];       /* see team_edges */
    uint keys[TEAM];
    uchar origins[TEAM];  /* of each face, its number before those without vertices were left out */
    int place;            /* of the first face in the arrays of faces */
    bool right;           /* whether the member that repairs the cell succeeded */
    uint words[3 + TEAM]; /* see team_t */
} team_cell_t;

#define TERMS (4 + SECONDS) /* sums over the faces of a cell */

/* What members know of a cell with vertices: the shares of their face, their sum of the second moments, the largest
   squared distance of a vertex, and the walls that the cell crosses, one bit each. */
typedef struct {
    REAL4 of_face;
    REAL second, reach2;
    uint walls;
} placed_t;

/* Whether a cell with vertices as far as `reach` crosses a wall at the distance `room`, toward which its vertices
   extend by `extent`. */
inline bool crosses(REAL room, REAL reach, REAL extent)
{
    const REAL noise = WALL_NOISE(reach);
    return !(reach <= room + noise || extent <= room + noise);
}

/* Find the vertices, TEAM at once, and sum them up; see place_corners. `fits` becomes whether no vertex lies beyond
   another face. The sums are incomplete if one does. */
inline bool team_place(local team_cell_t *at, team_t *team, REAL4 x, const rows_t *in, placed_t *placed, bool *fits)
{
    local corners_t *cell = &at->cell;
    const int lane = team->lane, corner_count = cell->corners, faces = cell->faces;
    const bool has_face = lane < faces;
    bool good = true, fit = true;
    /* The member's number of the sums over the cell: volume, first and second moments. */
    const int second_of_lane = lane < TERMS ? lane - (TERMS - SECONDS) : -1;
    REAL second = 0;
    REAL4 of_face = 0;
    at->vertices[0][lane] = at->vertices[1][lane] = 0;
    TEAM_SYNC();
    for (int begin = 0; begin < corner_count; begin += TEAM) {
        const int v = begin + lane;
        if (v < corner_count) {
            const uchar4 f = cell->at[v];
            const REAL4 pa = cell->planes[f.s0], pb = cell->planes[f.s1], pc = cell->planes[f.s2];
            const places_t a = {pa.s0, pa.s1, pa.s2}, b = {pb.s0, pb.s1, pb.s2}, c = {pc.s0, pc.s1, pc.s2};
            corner_t corner;
            find_corner(&corner, &a, &b, &c);
            const places_t y = corner.y;
            cell->x[v] = y.x;
            cell->y[v] = y.y;
            cell->z[v] = y.z;
            good &= corner.good > 0;
            shares_t share;
            share_corner(&share, &corner, &a, &b, &c, pa.s3, pb.s3, pc.s3, 1);
            local REAL4 *shares = at->work.sums.shares + lane;
            local REAL *seconds = at->work.sums.seconds + lane;
            shares[0] = (REAL4)(share.a, share.first_a.x, share.first_a.y, share.first_a.z);
            shares[TEAM] = (REAL4)(share.b, share.first_b.x, share.first_b.y, share.first_b.z);
            shares[2 * TEAM] = (REAL4)(share.c, share.first_c.x, share.first_c.y, share.first_c.z);
            seconds[0] = share.xx;
            seconds[TEAM] = share.yy;
            seconds[2 * TEAM] = share.zz;
            seconds[3 * TEAM] = share.yz;
            seconds[4 * TEAM] = share.zx;
            seconds[5 * TEAM] = share.xy;
            local uint *sets = at->vertices[begin / TEAM];
            atomic_or(sets + f.s0, (uint)1 << lane);
            atomic_or(sets + f.s1, (uint)1 << lane);
            atomic_or(sets + f.s2, (uint)1 << lane);
        }
        TEAM_SYNC();
        for (uint rest = has_face ? at->vertices[begin / TEAM][lane] : 0; rest != 0; rest &= rest - 1) {
            const int k = 31 - (int)clz(rest & -rest);
            const uchar4 g = cell->at[begin + k];
            of_face += at->work.sums.shares[(g.s0 == lane ? 0 : (g.s1 == lane ? TEAM : 2 * TEAM)) + k];
        }
        const int here = min(corner_count - begin, TEAM);
        for (int k = 0; second_of_lane >= 0 && k < here; ++k)
            second += at->work.sums.seconds[TEAM * second_of_lane + k];
        TEAM_SYNC();
    }
    placed->of_face = of_face;
    placed->second = second;

    REAL far2 = 0;
    REAL4 below = 0, above = 0;
    for (int v = lane; v < corner_count; v += TEAM) {
        const REAL4 place = corner_place(cell, v);
        const places_t y = {place.s0, place.s1, place.s2};
        REAL beyond = -1;
        for (int f = 0; f < faces; ++f) {
            const REAL4 p = cell->planes[f];
            const REAL s = fma(p.s0, y.x, fma(p.s1, y.y, p.s2 * y.z));
            beyond = s > beyond ? s : beyond;
        }
        cell->beyond[v] = beyond - R(0.5);
        fit &= !(beyond > R(0.5) + BEYOND_NOISE) && !(beyond - R(0.5) > BEYOND_NOISE);
        const REAL y2 = product_of(&y, &y);
        far2 = y2 > far2 ? y2 : far2;
        below = fmax(below, -place);
        above = fmax(above, place);
    }
    const REAL reach2 = team_largest(team, far2), reach = sqrt(reach2);
    uint walls = 0;
    for (int v = lane; own_count(&in->own) > 0 && v < corner_count; v += TEAM)
        walls |= own_planes_before(corner_place(cell, v), WALL_NOISE(reach), &in->own);
    const REAL4 low = x - in->box_lower, high = in->box_upper - x;
    if (!WALLS_MOVE)
        walls = (uint)crosses(low.s0, reach, below.s0) | (uint)crosses(high.s0, reach, above.s0) << 1 |
                (uint)crosses(low.s1, reach, below.s1) << 2 | (uint)crosses(high.s1, reach, above.s1) << 3 |
                (uint)crosses(low.s2, reach, below.s2) << 4 | (uint)crosses(high.s2, reach, above.s2) << 5;
    placed->reach2 = reach2;
    placed->walls = team_or(team, walls);
    *fits = team_ballot(team, !fit) == 0;
    return team_ballot(team, !good || (has_face && !(cell->planes[lane].s3 > LEAST_NEAREST2 * reach2))) == 0;
}

/* The set of the faces that follow the face of a member at vertices; see find_edges. */
inline uint team_edges(local team_cell_t *at, int lane)
{
    at->edges[lane] = 0;
    TEAM_SYNC();
    for (int v = lane; v < at->cell.corners; v += TEAM) {
        const uchar4 f = at->cell.at[v];
        atomic_or(at->edges + f.s0, (uint)1 << f.s1);
        atomic_or(at->edges + f.s1, (uint)1 << f.s2);
        atomic_or(at->edges + f.s2, (uint)1 << f.s0);
    }
    TEAM_SYNC();
    return at->edges[lane];
}

/* Remove all links, and link the vertices; see link_corners. */
inline void team_link(local team_cell_t *at, int lane)
{
    local uint *words = (local uint *)at->work.links.at;
    for (int k = lane; 4 * k < at->cell.faces * MOST_FACES; k += TEAM)
        words[k] = ~(uint)0; /* NO_CORNER, four times */
    TEAM_SYNC();
    for (int v = lane; v < at->cell.corners; v += TEAM) {
        const uchar4 f = at->cell.at[v];
        link_corner(&at->cell, &at->work.links, v, f.s0, f.s1, f.s2);
    }
    TEAM_SYNC();
}

/* Number the faces that have vertices anew; see number_faces. `next`: the edges of the member's face. */
inline bool team_number(local team_cell_t *at, team_t *team, uint next)
{
    local corners_t *cell = &at->cell;
    const int lane = team->lane, corner_count = cell->corners;
    const uint alive = team_ballot(team, next != 0);
    const int faces = popcount(alive);
    if (faces < 4 || corner_count != 2 * faces - 4)
        return false;
    const int label = cell->labels[lane], to = popcount(alive & BELOW(lane));
    const REAL4 plane = cell->planes[lane];
    TEAM_SYNC();
    if (next != 0) {
        cell->labels[to] = label;
        cell->planes[to] = plane;
        at->origins[to] = lane;
    }
    for (int v = lane; v < corner_count; v += TEAM) {
        const uchar4 f = cell->at[v];
        cell->at[v] =
            (uchar4)(popcount(alive & BELOW(f.s0)), popcount(alive & BELOW(f.s1)), popcount(alive & BELOW(f.s2)), 0);
    }
    if (lane == 0)
        cell->faces = faces;
    TEAM_SYNC();
    return true;
}

/* Find the vertices by flips if `known` faces have some, else by a walk: the work of one member. */
inline bool repair_alone(local team_cell_t *at, int known)
{
    return known > 0 ? repair_corners(&at->cell, &at->work.links, known) : walk_corners(&at->cell, &at->work.links);
}

/* Find the vertices among all `faces`: from the earlier vertices of the first `known`, else by a walk. One member does
   it. Faces with new edges between them become neighbors. False if the cell remains wrong. */
inline bool team_repair(local team_cell_t *at, team_t *team, int faces, int known, REAL4 x, const rows_t *in,
                        global int *marks)
{
    local corners_t *cell = &at->cell;
    const int lane = team->lane;
    if (lane == 0)
        cell->faces = faces;
    const uint old = team_edges(at, lane);
    team_link(at, lane);
    if (lane == 0)
        at->right = known > 0 && repair_alone(at, known);
    TEAM_SYNC();
    if (!at->right) {
        if (lane < faces)
            cell->planes[lane] = plane_of_face(cell->labels[lane], x, in); /* flips may have removed it */
        TEAM_SYNC();
        if (lane == 0)
            cell->corners = 0;
        team_link(at, lane);
        if (lane == 0)
            at->right = repair_alone(at, 0);
        TEAM_SYNC();
        if (!at->right)
            return false;
    }
    const uint next = team_edges(at, lane);
    for (uint rest = next & ~old; rest != 0; rest &= rest - 1)
        add_neighbor(cell->labels[lane], cell->labels[popcount(~rest & (rest - 1))], in, marks);
    return team_number(at, team, next);
}

/* The key of the member's face; see write_keys. */
inline uint team_key(local team_cell_t *at, int lane)
{
    local const corners_t *cell = &at->cell;
    at->keys[lane] = 0;
    at->edges[lane] = hash_of_label(cell->labels[lane]);
    TEAM_SYNC();
    for (int v = lane; v < cell->corners; v += TEAM) {
        const uchar4 f = cell->at[v];
        const uint a = at->edges[f.s0], b = at->edges[f.s1], c = at->edges[f.s2];
        atomic_add(at->keys + f.s0, b * c);
        atomic_add(at->keys + f.s1, c * a);
        atomic_add(at->keys + f.s2, a * b);
    }
    TEAM_SYNC();
    return at->keys[lane];
}

/* Per team and generator i: the cell of update_cells, with the same bits. A sum over vertices or faces is the work of
   one member, in their order. */
kernel TEAM_GROUP void update_cells_by_teams(const int size, const int which, const int n, global const int *listed,
                                             global const int *further, global const int *old_starts,
                                             global const int *old_neighbors, const int known,
                                             global const uchar4 *old_corners, global const uint *old_keys,
                                             global const REAL *points, CLIP_BOX_ARGS, const int room, CELL_OUTPUT_ARGS,
                                             global uint *keys, global int *changed, global int *more,
                                             global int *marks PERIOD_ARGS)
{
    local team_cell_t shared;
    local team_cell_t *at = &shared;
    local corners_t *cell = &at->cell;
    const int item = get_global_id(0) / TEAM, lane = get_local_id(0) % TEAM;
    if (item >= size || (which == MARKED_CELLS && item >= report[REPORT_PLACED]))
        return;
    const int what = which == ALL_CELLS ? item : listed[item], i = max(what, ~what);
    const rows_t in = ROWS(i);
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    team_t team = {at->words, lane, 0};
    if (lane < 3)
        at->words[lane] = 0;
    if (item == 0 && lane == 0)
        report[REPORT_MARKED] = 0; /* they are counted again */
    if (lane == 0) {
        row_counts[i] = UNFINISHED;
        changed[i] = ALL_FACES;
    }
    TEAM_SYNC();

    /* The previous neighbors, and further ones in ascending order. */
    const int start = old_starts[i], before = old_starts[i + 1] - start;
    int faces = before;
    if (which == MARKED_CELLS) {
        const int label = lane < MORE ? further[MORE * item + lane] : NO_NEIGHBOR;
        faces += popcount(team_ballot(&team, label != NO_NEIGHBOR));
        int to = before;
        for (int k = 0; k < MORE; ++k) {
            const int other = further[MORE * item + k];
            to += other != NO_NEIGHBOR && other < label;
        }
        if (label != NO_NEIGHBOR && to < MOST_FACES)
            cell->labels[to] = label;
    }
    if (what < 0 || before < 4 || faces > MOST_FACES)
        return;
    if (lane < before)
        cell->labels[lane] = old_neighbors[start + lane];
    TEAM_SYNC();
    if (team_ballot(&team, lane < faces && must_clip(cell->labels[lane], &in)) != 0)
        return;
    cell->planes[lane] = lane < faces ? plane_of_face(cell->labels[lane], x, &in) : 0;
    at->origins[lane] = lane;
    const int state = known ? old_corners[2 * start].s3 : NO_CORNERS;
    const bool has_corners = state != NO_CORNERS;
    if (lane == 0) {
        cell->corners = has_corners ? 2 * before - 4 : 0;
        cell->faces = has_corners ? before : faces;
    }
    for (int v = lane; has_corners && v < 2 * before - 4; v += TEAM)
        cell->at[v] = old_corners[2 * start + v];
    TEAM_SYNC();

    placed_t placed;
    bool good = false, done = false, kept = false;
    for (int turn = has_corners ? 0 : 1; turn < 2 && !done; ++turn) {
        if (turn == 1 && !team_repair(at, &team, faces, good ? before : 0, x, &in, marks))
            return;
        bool fits;
        good = team_place(at, &team, x, &in, &placed, &fits);
        kept = turn == 0 && faces == before;
        done = good && fits && (turn == 1 || kept);
    }
    if (!done || !has_nearest_images(placed.reach2, &in) || !knows_walls(i, placed.reach2, &in.own))
        return;
    if (placed.walls != 0) {
        if ((placed.walls >> lane) & 1)
            add_neighbor(i, own_label(&in.own, lane), &in, marks);
        return;
    }
    int place = start;
    faces = cell->faces;
    if (faces > before) {
        if (lane == 0)
            at->place = take_places(report, faces);
        TEAM_SYNC();
        place = at->place;
    }
    if (place + faces > room)
        return;

    /* The faces, and the sums of their terms. */
    local REAL *terms = (local REAL *)at->work.sums.shares;
    const bool has_face = lane < faces;
    const int label = cell->labels[lane];
    face_t face;
    if (has_face) {
        measure_face(&face, cell, lane, cell->planes[lane], placed.of_face, placed.reach2);
        terms[lane] = face.volume;
        terms[TEAM + lane] = face.first.s0;
        terms[2 * TEAM + lane] = face.first.s1;
        terms[3 * TEAM + lane] = face.first.s2;
        for (int k = 0; k < SECONDS; ++k)
            terms[(TERMS - SECONDS + k) * TEAM + lane] = face.seconds[k];
    }
    TEAM_SYNC();
    REAL sum = placed.second;
    for (int f = 0; lane < TERMS && f < faces; ++f)
        sum += terms[TEAM * lane + f];
    TEAM_SYNC();
    if (lane < TERMS)
        terms[lane] = sum;
    TEAM_SYNC();
    const REAL volume = terms[0];
    if (team_ballot(&team, (has_face && !face.wide) || !(volume > 0)) != 0)
        return;

    const bool same = kept && state == KNOWN_CORNERS;
    uint differ = 0;
    if (!same) {
        const uint key = team_key(at, lane);
        const int origin = state == KNOWN_CORNERS && which != MARKED_CELLS ? at->origins[lane] : before;
        differ = team_ballot(&team, has_face && (origin >= before || old_keys[start + origin] != key));
    }
    const measured_t out = {labels, measures, centroids, volumes, offsets, covariances};
    if (has_face) {
        put_face(place + lane, label, &face, &out);
        keys[place + lane] = same ? old_keys[start + lane] : at->keys[lane];
    }
    for (int v = lane; v < cell->corners; v += TEAM) {
        uchar4 f = cell->at[v];
        f.s3 = v == 0 ? KNOWN_CORNERS : 0;
        corners[2 * place + v] = f;
    }
    if (lane == 0) {
        row_places[i] = place;
        row_counts[i] = faces | CERTAIN;
        changed[i] = (int)differ;
        REAL seconds[SECONDS];
        for (int k = 0; k < SECONDS; ++k)
            seconds[k] = terms[TERMS - SECONDS + k];
        put_moments(i, volume, (REAL4)(terms[1], terms[2], terms[3], 0), seconds, &out);
    }
}
