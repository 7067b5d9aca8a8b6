#include "tessellation/team.h"
#include "tessellation/update_rows.h"

/* A cell in the local memory of its team: a face per member, and two vertices. */
typedef struct {
    int corners;
    uchar4 at[MOST_CORNERS];                                /* faces of a vertex */
    REAL x[MOST_CORNERS], y[MOST_CORNERS], z[MOST_CORNERS]; /* its position */
    REAL4 planes[TEAM];                                     /* of the faces: p and d^2 */
    uint hashes[TEAM];                                      /* of their labels */
    uint vertices[2][TEAM];                                 /* of each face: its first 32 vertices, and the others */
    REAL4 shares[3 * TEAM]; /* of TEAM vertices, for their three faces; later, see TERMS */
    REAL seconds[6 * TEAM]; /* of these vertices */
    uint words[3 + TEAM];   /* see team_t */
} team_cell_t;

inline REAL4 team_corner_place(local const team_cell_t *cell, int v)
{
    return (REAL4)(cell->x[v], cell->y[v], cell->z[v], 0);
}

#define CORNERS local team_cell_t
#define CORNER_PLACE team_corner_place
#include "tessellation/corner_measures.h"

#define TERMS (4 + SECONDS) /* sums over the faces of a cell */

/* Find vertex v, and write its shares. False if its faces are nearly parallel or not counter-clockwise, or if it lies
   beyond another face. */
inline bool place_team_corner(local team_cell_t *cell, int v, int lane, int faces, corner_t *corner)
{
    const uchar4 at = cell->at[v];
    const REAL4 pa = cell->planes[at.s0], pb = cell->planes[at.s1], pc = cell->planes[at.s2];
    const places_t a = {pa.s0, pa.s1, pa.s2}, b = {pb.s0, pb.s1, pb.s2}, c = {pc.s0, pc.s1, pc.s2};
    find_corner(corner, &a, &b, &c);
    const places_t y = corner->y;
    cell->x[v] = y.x;
    cell->y[v] = y.y;
    cell->z[v] = y.z;
    REAL beyond = -1;
    for (int f = 0; f < faces; ++f) {
        const REAL4 p = cell->planes[f];
        const REAL s = fma(p.s0, y.x, fma(p.s1, y.y, p.s2 * y.z));
        beyond = s > beyond ? s : beyond;
    }
    shares_t share;
    share_corner(&share, corner, &a, &b, &c, pa.s3, pb.s3, pc.s3, 1);
    cell->shares[lane] = (REAL4)(share.a, share.first_a.x, share.first_a.y, share.first_a.z);
    cell->shares[TEAM + lane] = (REAL4)(share.b, share.first_b.x, share.first_b.y, share.first_b.z);
    cell->shares[2 * TEAM + lane] = (REAL4)(share.c, share.first_c.x, share.first_c.y, share.first_c.z);
    cell->seconds[lane] = share.xx;
    cell->seconds[TEAM + lane] = share.yy;
    cell->seconds[2 * TEAM + lane] = share.zz;
    cell->seconds[3 * TEAM + lane] = share.yz;
    cell->seconds[4 * TEAM + lane] = share.zx;
    cell->seconds[5 * TEAM + lane] = share.xy;
    return corner->good > 0 && !(beyond > R(0.5) + BEYOND_NOISE) && !(beyond - R(0.5) > BEYOND_NOISE);
}

/* Whether a cell with vertices as far as `reach` lies behind a wall at the distance `room`, toward which its vertices
   extend by `extent`. */
inline bool stays_behind(REAL room, REAL reach, REAL extent)
{
    const REAL noise = 64 * REAL_EPS * (1 + reach);
    return reach <= room + noise || extent <= room + noise;
}

/* Per team and generator i: the cell of update_cells, with the same bits, if it keeps its previous vertices. Others are
   listed for update_cells, and counted in report[REPORT_MARKED], which is 0 before. A sum over vertices or faces is the
   work of one member, in their order. */
kernel TEAM_GROUP void update_cells_by_teams(const int size, global int *listed, global const int *old_starts,
                                             global const int *old_neighbors, const int known,
                                             global const uchar4 *old_corners, global const uint *old_keys,
                                             global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                                             const int room, CELL_OUTPUT_ARGS, global uint *keys,
                                             global int *changed PERIOD_ARGS)
{
    local team_cell_t shared;
    local team_cell_t *cell = &shared;
    const int i = get_global_id(0) / TEAM, lane = get_local_id(0) % TEAM;
    if (i >= size)
        return;
    const int start = old_starts[i], faces = old_starts[i + 1] - start, corner_count = 2 * faces - 4;
    const int state = faces >= 4 && faces <= MOST_FACES && known ? old_corners[2 * start].s3 : NO_CORNERS;
    if (state == NO_CORNERS || start + faces > room) {
        if (lane == 0)
            listed[atomic_inc(report + REPORT_MARKED)] = i;
        return;
    }
    const rows_t in = {old_starts, old_neighbors, 0, points, box_lower, box_upper PERIODS};
    const REAL4 x = (REAL4)(points[3 * i], points[3 * i + 1], points[3 * i + 2], 0);
    team_t team = {cell->words, lane, 0};
    if (lane < 3)
        cell->words[lane] = 0;
    if (lane == 0)
        cell->corners = corner_count;
    cell->vertices[0][lane] = cell->vertices[1][lane] = 0;
    const bool has_face = lane < faces;
    const int label = has_face ? old_neighbors[start + lane] : 0;
    const REAL4 plane = has_face ? plane_of_face(label, x, &in) : 0;
    cell->planes[lane] = plane;
    cell->hashes[lane] = hash_of_label(label);
    TEAM_SYNC();

    /* The vertices, TEAM at once, and the sums of their shares. */
    bool good = true;
    /* The member's number of the sums over the cell: volume, first and second moments. */
    const int second_of_lane = lane < TERMS ? lane - (TERMS - SECONDS) : -1;
    REAL far2 = 0, sum = 0;
    REAL4 of_face = 0, below = 0, above = 0;
    for (int begin = 0; begin < corner_count; begin += TEAM) {
        const int v = begin + lane;
        if (v < corner_count) {
            const uchar4 at = old_corners[2 * start + v];
            cell->at[v] = at;
            corner_t corner;
            good &= place_team_corner(cell, v, lane, faces, &corner);
            far2 = corner.y2 > far2 ? corner.y2 : far2;
            const REAL4 y = team_corner_place(cell, v);
            below = fmax(below, -y);
            above = fmax(above, y);
            local uint *sets = cell->vertices[begin / TEAM];
            atomic_or(sets + at.s0, (uint)1 << lane);
            atomic_or(sets + at.s1, (uint)1 << lane);
            atomic_or(sets + at.s2, (uint)1 << lane);
        }
        TEAM_SYNC();
        for (uint rest = has_face ? cell->vertices[begin / TEAM][lane] : 0; rest != 0; rest &= rest - 1) {
            const int k = 31 - (int)clz(rest & -rest);
            const uchar4 at = cell->at[begin + k];
            of_face += cell->shares[(at.s0 == lane ? 0 : (at.s1 == lane ? TEAM : 2 * TEAM)) + k];
        }
        const int here = min(corner_count - begin, TEAM);
        for (int k = 0; second_of_lane >= 0 && k < here; ++k)
            sum += cell->seconds[TEAM * second_of_lane + k];
        TEAM_SYNC();
    }
    const REAL reach2 = team_largest(&team, far2), reach = sqrt(reach2);
    const REAL4 low = x - box_lower, high = box_upper - x;
    good = good && (!has_face || plane.s3 > LEAST_NEAREST2 * reach2) && has_nearest_images(reach2, &in);
    good = good && stays_behind(low.s0, reach, below.s0) && stays_behind(high.s0, reach, above.s0) &&
           stays_behind(low.s1, reach, below.s1) && stays_behind(high.s1, reach, above.s1) &&
           stays_behind(low.s2, reach, below.s2) && stays_behind(high.s2, reach, above.s2);

    /* The faces, and the sums of their terms. */
    local REAL *terms = (local REAL *)cell->shares;
    face_t face;
    if (has_face) {
        measure_face(&face, cell, lane, plane, of_face, reach2);
        good &= face.wide;
        terms[lane] = face.volume;
        terms[TEAM + lane] = face.first.s0;
        terms[2 * TEAM + lane] = face.first.s1;
        terms[3 * TEAM + lane] = face.first.s2;
        for (int k = 0; k < SECONDS; ++k)
            terms[(TERMS - SECONDS + k) * TEAM + lane] = face.seconds[k];
    }
    TEAM_SYNC();
    for (int f = 0; lane < TERMS && f < faces; ++f)
        sum += terms[TEAM * lane + f];
    TEAM_SYNC();
    if (lane < TERMS)
        terms[lane] = sum;
    TEAM_SYNC();
    const REAL volume = terms[0];
    if (team_ballot(&team, !good || !(volume > 0)) != 0) {
        if (lane == 0)
            listed[atomic_inc(report + REPORT_MARKED)] = i;
        return;
    }

    const measured_t out = {labels, measures, centroids, volumes, offsets, covariances};
    const bool same = state == KNOWN_CORNERS;
    if (has_face) {
        put_face(start + lane, label, &face, &out);
        uint key = same ? old_keys[start + lane] : 0;
        for (int v = 0; !same && v < corner_count; ++v) {
            const uchar4 at = cell->at[v];
            if (at.s0 == lane || at.s1 == lane || at.s2 == lane)
                key += cell->hashes[at.s0 == lane ? at.s1 : at.s0] * cell->hashes[at.s2 == lane ? at.s1 : at.s2];
        }
        keys[start + lane] = key;
    }
    for (int v = lane; v < corner_count; v += TEAM) {
        uchar4 at = cell->at[v];
        if (v == 0)
            at.s3 = KNOWN_CORNERS;
        corners[2 * start + v] = at;
    }
    if (lane == 0) {
        row_places[i] = start;
        row_counts[i] = faces | CERTAIN;
        changed[i] = same ? 0 : (int)(~(uint)0 >> (MOST_FACES - faces));
        REAL seconds[SECONDS];
        for (int k = 0; k < SECONDS; ++k)
            seconds[k] = terms[TERMS - SECONDS + k];
        put_moments(i, volume, (REAL4)(terms[1], terms[2], terms[3], 0), seconds, &out);
    }
}
