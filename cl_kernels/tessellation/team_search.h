/* The search of a team for the generators that may cut its cell; see search.h. */
#include "tessellation/team_clip.h"

/* Clip by the `count` items in `places`, roughly the nearest first; see clip_by_batch. A counting sort by shells keeps
   the order of the items of a shell. Returns FLAG_* or 0. */
inline int team_clip_batch(local shared_t *at, team_t *team, known_t *known, REAL4 x, int count, REAL per_shell,
                           bool warm, const search_t *in)
{
    const int lane = team->lane;
    const uint below = BELOW(lane);
    at->starts[lane] = 0;
    TEAM_SYNC();
    for (int k = lane; k < count; k += TEAM) {
        const REAL place = vector_to_item(at->places[k], x, in).s3 * per_shell;
        const int shell = place < SHELLS - 1 ? (int)place : SHELLS - 1;
        at->shells[k] = shell;
        atomic_inc(at->starts + shell);
    }
    TEAM_SYNC();
    int all;
    at->starts[lane] = team_scan(team, at->starts[lane], &all);
    TEAM_SYNC();
    for (int begin = 0; begin < count; begin += TEAM) {
        const int k = begin + lane;
        const bool valid = k < count;
        const int shell = valid ? at->shells[k] : 0;
        uint peers = team_ballot(team, valid); /* items of the same shell, one bit of its number after the other */
        for (int b = 0; b < 5; ++b) {
            const bool bit = (shell >> b) & 1;
            const uint set = team_ballot(team, bit);
            peers &= bit ? set : ~set;
        }
        const int rank = popcount(peers & below), start = at->starts[shell];
        if (valid)
            at->sorted[start + rank] = k;
        TEAM_SYNC();
        if (valid && rank == 0)
            at->starts[shell] = start + popcount(peers);
        TEAM_SYNC();
    }
    for (int begin = 0; begin < count; begin += TEAM) {
        const int k = begin + lane;
        const int q = at->places[at->sorted[min(k, count - 1)]];
        at->ways[lane] = vector_to_item(q, x, in);
        at->labels[lane] = in->items[q];
        TEAM_SYNC();
        /* The generators that can still cut; after each cut there are fewer. */
        uint left = team_ballot(team, k < count && at->ways[lane].s3 < 4 * known->reach2);
        while (left != 0) {
            const int next = 31 - (int)clz(left & -left);
            left &= left - 1;
            const REAL4 d = at->ways[next];
            if (d.s3 == 0)
                return FLAG_COINCIDE;
            const int what = team_clip(at, team, known, d, d.s3, at->labels[next], warm, in->points);
            if (what >= CLIP_FULL)
                return flag_of(what);
            if (what == CLIP_CUT)
                left &= team_ballot(team, at->ways[lane].s3 < 4 * known->reach2);
        }
        TEAM_SYNC();
    }
    return 0;
}

/* List in `places` all items that `find_items` finds, a row of bins per member, except `own` and those beyond the root
   of `limit`. Returns their number; or -1 if bins are divided, or if BATCH is too few before those beyond are left out.
 */
inline int team_gather(local shared_t *at, team_t *team, REAL limit, REAL4 x, int own, REAL w, REAL inner,
                       const search_t *in)
{
    const int lane = team->lane;
    const FRAME frame = in->grid_frames[0];
    const int4 shape = in->grid_shapes[0];
    const REAL noise_y = bin_noise(x.s1, frame.s1), noise_z = bin_noise(x.s2, frame.s2);
    const REAL inverse = FRAME_INVERSE(frame), edge = 1 / inverse;
    const int2 ys = bin_range(x.s1, w, frame.s1, inverse, shape.s2);
    const int2 zs = bin_range(x.s2, w, frame.s2, inverse, shape.s3);
    int2 done_x = (int2)(0, -1), done_y = done_x, done_z = done_x;
    if (inner >= 0) {
        done_x = bin_range(x.s0, inner, frame.s0, inverse, shape.s1);
        done_y = bin_range(x.s1, inner, frame.s1, inverse, shape.s2);
        done_z = bin_range(x.s2, inner, frame.s2, inverse, shape.s3);
    }
    const int wide = ys.s1 - ys.s0 + 1, rows = wide * (zs.s1 - zs.s0 + 1);
    int scanned = 0;
    for (int begin = 0; begin < rows; begin += TEAM) {
        const int r = begin + lane;
        int2 left = 0, right = 0; /* items of the row */
        bool divided = false;
        if (r < rows) {
            const int iz = zs.s0 + r / wide, iy = ys.s0 + r % wide;
            const REAL away_z = row_distance(x.s2, frame.s2, edge, iz, edge * BIN_SHARE + noise_z);
            const REAL away_y = row_distance(x.s1, frame.s1, edge, iy, edge * BIN_SHARE + noise_y);
            const REAL left2 = limit - away_y * away_y - away_z * away_z;
            if (left2 > 0) {
                const REAL span = left2 < w * w ? sqrt(left2) * (1 + 8 * REAL_EPS) + edge * R(1e-6) : w;
                const int2 xs = bin_range(x.s0, span, frame.s0, inverse, shape.s1);
                global const int2 *row_bins = in->bins + shape.s0 + (iz * shape.s2 + iy) * shape.s1;
                const bool row_done = iz >= done_z.s0 && iz <= done_z.s1 && iy >= done_y.s0 && iy <= done_y.s1;
                const int2 first = row_bins[xs.s0], last = row_bins[xs.s1 + 1];
                divided = first.s1 != last.s1;
                if (!row_done) {
                    left = (int2)(first.s0, last.s0);
                } else {
                    const int to = min(xs.s1, done_x.s0 - 1), from = max(xs.s0, done_x.s1 + 1);
                    if (xs.s0 <= to)
                        left = (int2)(first.s0, row_bins[to + 1].s0);
                    if (from <= xs.s1)
                        right = (int2)(row_bins[from].s0, last.s0);
                }
            }
        }
        if (team_ballot(team, divided) != 0)
            return -1;
        int all;
        const int mine = left.s1 - left.s0 + right.s1 - right.s0;
        int to = scanned + team_scan(team, mine, &all);
        scanned += all;
        if (scanned > BATCH)
            return -1;
        for (int q = left.s0; q < left.s1; ++q)
            at->places[to++] = q;
        for (int q = right.s0; q < right.s1; ++q)
            at->places[to++] = q;
    }
    TEAM_SYNC();
    int count = 0;
    for (int begin = 0; begin < scanned; begin += TEAM) {
        const int k = begin + lane, q = at->places[min(k, scanned - 1)];
        const bool found = k < scanned && q != own && vector_to_item(q, x, in).s3 < limit;
        const uint all = team_ballot(team, found);
        TEAM_SYNC();
        if (found)
            at->places[count + popcount(all & BELOW(lane))] = q;
        count += popcount(all);
    }
    TEAM_SYNC();
    return count;
}

/* Clip the cell by all generators within w that may cut it; see clip_cell_by_bins. Where `team_gather` cannot list them
   at once, they come from `find_items` in batches. */
inline int team_clip_by_bins(local shared_t *at, team_t *team, known_t *known, REAL4 x, int own, REAL w, REAL inner,
                             bool warm, const search_t *in)
{
    const REAL per_shell = SHELLS / (6 * w * w);
    const int lane = team->lane;
    const int gathered = team_gather(at, team, 4 * known->reach2, x, own, w, inner, in);
    grid_walk_t walk;
    open_grid(&walk, 0, 0, inner >= 0);
    walk.begin = walk.end = 0;
    bool more = true;
    while (more) {
        int count = max(gathered, 0);
        more = gathered < 0;
        const REAL limit = 4 * known->reach2;
        while (more && count < BATCH) {
            if (walk.begin == walk.end && !(more = find_items(&walk, x, w, inner, limit, in)))
                break;
            const int stop = min(walk.end, walk.begin + BATCH - count);
            for (int begin = walk.begin; begin < stop; begin += TEAM) {
                const int q = begin + lane;
                const bool found = q < stop && q != own && vector_to_item(min(q, stop - 1), x, in).s3 < limit;
                const uint all = team_ballot(team, found);
                if (found)
                    at->places[count + popcount(all & BELOW(lane))] = q;
                count += popcount(all);
            }
            walk.begin = stop;
        }
        TEAM_SYNC();
        const int flag = team_clip_batch(at, team, known, x, count, per_shell, warm, in);
        if (flag != 0)
            return flag;
        TEAM_SYNC();
    }
    return 0;
}
