#include "tessellation/team_search.h"
#include "tessellation/cell_output.h"

#define TERMS 11 /* sums over the faces of a cell */

/* Per team p, in bin order: the cell of generator i = items[p], its faces and its measures, with the bits of
   clip_polyhedra (see there). For boxes with walls, without weights, and cells of up to FACE_CAPACITY = TEAM faces;
   others stay UNFINISHED.

   The cell lies in local memory, and its vertices and faces are done at once. A work-item alone has it in private
   memory, and does them one after the other. */
kernel TEAM_GROUP void clip_polyhedra_by_teams(const int size, const int rows, global const REAL *binned,
                                               global const int *items, global float *reach, BIN_ARGS,
                                               global const REAL *points, const REAL4 box_lower, const REAL4 box_upper,
                                               const int warm, global const int *old_starts,
                                               global const int *old_neighbors, const int again, const int room,
                                               const REAL share, CELL_OUTPUT_ARGS)
{
    local shared_t shared;
    local shared_t *at = &shared;
    local cell_t *cell = &at->cell;
    const int p = get_global_id(0) / TEAM, lane = get_local_id(0) % TEAM;
    if (p >= size)
        return;
    const int i = items[p];
    if (i >= rows || (again && row_counts[i] != UNFINISHED))
        return;
    team_t team = {at->words, lane, 0};
    const search_t in = {points, binned, items, bins, grid_frames, grid_shapes};
    const REAL4 x = (REAL4)(binned[3 * p], binned[3 * p + 1], binned[3 * p + 2], 0);
    known_t known;
    team_start(at, &team, &known, x, box_lower, box_upper);
    int flag = 0;
    REAL w = fmax(reach[p], FLT_MIN), inner = -1; /* a radius of 0 would never widen */
    if (warm) {
        const int end = old_starts[i + 1];
        for (int k = old_starts[i]; k < end && flag == 0; ++k) {
            const int j = old_neighbors[k];
            if (j < 0)
                continue;
            const REAL4 d = (REAL4)(points[3 * j] - x.s0, points[3 * j + 1] - x.s1, points[3 * j + 2] - x.s2, 0);
            const REAL d2 = d.s0 * d.s0 + d.s1 * d.s1 + d.s2 * d.s2;
            flag = flag_of(d2 == 0 ? CLIP_COINCIDE : team_clip(at, &team, &known, d, d2, j, false, points));
        }
        w = 2 * sqrt(known.reach2) * (1 + 8 * REAL_EPS);
    }
    while (flag == 0) {
        flag = team_clip_by_bins(at, &team, &known, x, p, w, inner, warm, &in);
        const REAL need = 2 * sqrt(known.reach2) * (1 + 8 * REAL_EPS);
        if (!(need > w)) /* a NaN ends the loop, too */
            break;
        inner = w;
        w = need < 4 * w ? need : 2 * w;
    }
    if (flag != 0) {
        if (lane == 0) {
            atomic_or(report, flag);
            row_counts[i] = flag == FLAG_FULL ? UNFINISHED : 0;
        }
        return;
    }

    /* The last vertex of each face, as face_starts finds it. */
    const int n = known.n;
    const uint alive = known.alive;
    at->starts[lane] = 0;
    if (lane == 0) {
        reach[p] = (float)(2 * sqrt(known.reach2) * (1 + 8 * REAL_EPS));
        at->places[0] = take_places(report, n / 2 + 2);
    }
    TEAM_SYNC();
    for (int v = lane; v < n; v += TEAM) {
        const INDEX4 f = cell->faces[v];
        atomic_max(at->starts + f.s0, v);
        atomic_max(at->starts + f.s1, v);
        atomic_max(at->starts + f.s2, v);
    }
    TEAM_SYNC();

    /* A face per member. */
    const int face_count = n / 2 + 2, place = at->places[0];
    const bool fits = place + face_count <= room;
    const REAL reach_length = sqrt(known.reach2), near2 = sqrt(REAL_EPS) * known.reach2;
    const REAL slim = 512 * noise_length(reach_length);
    const bool mine = (alive >> lane) & 1;
    bool doubtful = known.torn, narrow = false, dropped = false;
    REAL part = 0, lost = 0, area = 0; /* part: of the volume */
    REAL4 face_first = 0, moved = 0, square = 0, mixed = 0;
    int label = 0;
    if (mine) {
        const REAL4 plane = cell->planes[lane];
        const REAL d2 = plane.s0 * plane.s0 + plane.s1 * plane.s1 + plane.s2 * plane.s2;
        const REAL inverse = 1 / sqrt(d2), height = plane.s3 / d2;
        const REAL4 normal = plane * inverse;
        int most = 3 * FACE_CAPACITY; /* steps, whatever happens */
        const int first_vertex = at->starts[lane];
        const REAL4 a = vertex_at(cell, first_vertex);
        int v = vertex_after(cell, first_vertex, lane);
        REAL4 b = vertex_at(cell, v);
        for (v = vertex_after(cell, v, lane); v != first_vertex && --most > 0; v = vertex_after(cell, v, lane)) {
            const REAL4 c = vertex_at(cell, v), s = a + b + c, across = cross3(b - a, c - a);
            const REAL weight = dot3(across, normal), other = dot3(across, plane);
            area += weight;
            face_first += weight * s;
            square += other * (a * a + b * b + c * c + s * s);
            mixed += other * (a.yzxw * a.zxyw + b.yzxw * b.zxyw + c.yzxw * c.zxyw + s.yzxw * s.zxyw);
            b = c;
        }
        part = normal.s3 * area;
        moved = normal.s3 * face_first;
        square *= height;
        mixed *= height;
        label = cell->labels[lane];
        const REAL across2 = label >= 0 ? d2 : known.reach2;
        const bool small = !(area > sqrt(REAL_EPS) * across2);
        if (small || !(area > slim * reach_length)) {
            REAL width2 = 0;
            for (v = vertex_after(cell, first_vertex, lane); v != first_vertex && --most > 0;
                 v = vertex_after(cell, v, lane)) {
                const REAL4 e = vertex_at(cell, v) - a;
                width2 = fmax(width2, dot3(e, e));
            }
            doubtful |= small && label >= 0;
            if (!(area > 16 * noise_length(sqrt(across2)) * sqrt(width2))) {
                lost = fabs(normal.s3 * area);
                dropped = true;
            }
            narrow |= !dropped && !(area > slim / 2 * sqrt(width2));
        }
        doubtful |= !dropped && across2 < near2;
    }
    const uint shown = team_ballot(&team, mine && !dropped);
    const int count = popcount(shown);
    if (mine && !dropped && fits)
        write_face(place + popcount(shown & BELOW(lane)), label, area, face_first, labels, measures, centroids);
    doubtful = team_ballot(&team, doubtful) != 0;
    narrow = team_ballot(&team, narrow) != 0;
    if (with_corners && fits) {
        const bool clear = !doubtful && !narrow && count == face_count && count <= MOST_FACES;
        for (int v = lane; v < n; v += TEAM) {
            const INDEX4 f = cell->faces[v];
            uchar4 at_v = (uchar4)(popcount(alive & BELOW(f.s0)), popcount(alive & BELOW(f.s1)),
                                   popcount(alive & BELOW(f.s2)), 0);
            if (v == 0)
                at_v.s3 = clear ? NEW_CORNERS : NO_CORNERS;
            if (clear || v == 0)
                corners[2 * place + v] = at_v;
        }
    }

    /* Sums over the faces in their order, for the bits of clip_polyhedra: member q sums number q of each face. The
       arrays of vertices hold the numbers: the cell begins with x, y, z, beyond and the planes, twelve rows of TEAM. */
    TEAM_SYNC();
    local REAL *terms = (local REAL *)cell;
    terms[lane] = part;
    terms[TEAM + lane] = moved.s0;
    terms[2 * TEAM + lane] = moved.s1;
    terms[3 * TEAM + lane] = moved.s2;
    terms[4 * TEAM + lane] = square.s0;
    terms[5 * TEAM + lane] = square.s1;
    terms[6 * TEAM + lane] = square.s2;
    terms[7 * TEAM + lane] = mixed.s0;
    terms[8 * TEAM + lane] = mixed.s1;
    terms[9 * TEAM + lane] = mixed.s2;
    terms[10 * TEAM + lane] = lost;
    TEAM_SYNC();
    REAL sum = 0;
    if (lane < TERMS)
        for (uint rest = alive; rest != 0; rest &= rest - 1)
            sum += terms[TEAM * lane + 31 - (int)clz(rest & -rest)];
    TEAM_SYNC();
    if (lane < TERMS)
        terms[lane] = sum;
    TEAM_SYNC();
    if (lane != 0)
        return;
    row_places[i] = place;
    row_counts[i] = count;
    if (doubtful || narrow)
        atomic_or(report, (doubtful ? FLAG_DOUBT : 0) | (narrow ? FLAG_NARROW : 0));
    flag_lost_faces(count, terms[0], terms[10], share, report);
    write_cell_moments(i, terms[0], (REAL4)(terms[1], terms[2], terms[3], 0), (REAL4)(terms[4], terms[5], terms[6], 0),
                       (REAL4)(terms[7], terms[8], terms[9], 0), volumes, offsets, covariances);
}
