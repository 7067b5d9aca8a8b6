#include "opencl/real.h"
#include "tessellation/bins.h"
#include "remapping/piece.h"

/* Outcomes of a cell. */
#define DONE 0
#define LIST_FULL 1   /* the cell overlaps more old cells than its list holds */
#define PIECE_LARGE 2 /* a piece has more faces than its arrays hold */
#define FAILED 3      /* the graph is not that of a Voronoi diagram */

#define WAITING 64 /* grids of bins that wait in a search */

/* A neighbor graph. Row i lists the neighbors of generator i; -1 - wall stands for a wall. */
typedef struct {
    global const REAL *points;
    global const int *starts, *neighbors;
} graph_t;

#define GRAPH_ARGS global const REAL *points, global const int *starts, global const int *neighbors
#define OLD_GRAPH_ARGS global const REAL *old_points, global const int *old_starts, global const int *old_neighbors

/* Cell data of the old mesh, `width` columns.

   values (n, width)        means q_j over the cells
   least, most (n, width)   bounds of the data inside a cell
   centroids (n, DIM)       c_j - x_j
   slopes (n, width, DIM)   g_j; not read unless with_slopes */
#define CELL_DATA_ARGS                                                                                                 \
    const int width, global const REAL *values, global const REAL *least, global const REAL *most,                     \
        global const REAL *centroids, const int with_slopes, global const REAL *slopes

/* The old cells found so far for one new cell: a queue, and a hash table with open addressing and 2 * capacity slots (a
   power of two) that holds the same indices. */
typedef struct {
    int n, capacity;
    global int *queue, *table;
} visited_t;

/* Add j unless it is listed already. Returns false if the queue is full. */
inline bool visit(visited_t *seen, int j)
{
    const int mask = 2 * seen->capacity - 1;
    int slot = (int)((uint)j * 2654435761u >> 7) & mask;
    while (seen->table[slot] >= 0) {
        if (seen->table[slot] == j)
            return true;
        slot = (slot + 1) & mask;
    }
    if (seen->n == seen->capacity)
        return false;
    seen->table[slot] = j;
    seen->queue[seen->n++] = j;
    return true;
}

/* The generator of `graph` nearest to x. Start at a generator in the bin of x, or near it, and move to a nearer
   neighbor until there is none. A point outside a generator's cell is nearer to one of its neighbors, so the walk
   cannot stop early. */
inline int nearest_generator(global const REAL *x, const graph_t *graph, int n, global const int *items, BIN_ARGS)
{
    int bin = bin_in_grid(x, grid_frames[0], grid_shapes[0]);
    while (bins[bin].s1 != bins[bin + 1].s1) {
        const int grid = bins[bin].s1;
        bin = bin_in_grid(x, grid_frames[grid], grid_shapes[grid]);
    }
    const REAL4 here = load_vector(x, 0);
    int j = items[min(bins[bin].s0, n - 1)], best = j;
    REAL4 d = load_vector(graph->points, j) - here;
    REAL best2 = dot_vectors(d, d);
    do {
        j = best;
        for (int k = graph->starts[j]; k < graph->starts[j + 1]; ++k) {
            const int q = graph->neighbors[k];
            if (q < 0 || q >= n)
                continue;
            d = load_vector(graph->points, q) - here;
            const REAL d2 = dot_vectors(d, d);
            if (d2 < best2) {
                best2 = d2;
                best = q;
            }
        }
    } while (best != j);
    return j;
}

/* Add the generators of `graph` within `farthest` of x, by the bins there. Grids of divided bins wait on a stack; those
   for which there is no room are not entered. Returns false if the queue is full. */
inline bool visit_near(visited_t *seen, REAL4 x, REAL farthest, const graph_t *graph, global const int *items, BIN_ARGS)
{
    int waiting[WAITING], n = 1;
    waiting[0] = 0;
    while (n > 0) {
        const int grid = waiting[--n];
        const FRAME frame = grid_frames[grid];
        const int4 shape = grid_shapes[grid];
        int low[3] = {0, 0, 0}, high[3] = {0, 0, 0};
        for (int a = 0; a < DIM; ++a) {
            const REAL at = a == 0 ? x.s0 : (a == 1 ? x.s1 : x.s2);
            const REAL origin = a == 0 ? frame.s0 : (a == 1 ? frame.s1 : frame.s2);
            const int side = a == 0 ? shape.s1 : (a == 1 ? shape.s2 : shape.s3);
            const REAL wide = farthest + bin_noise(fabs(at) + farthest, origin);
            low[a] = axis_bin(at - wide, origin, FRAME_INVERSE(frame), side);
            high[a] = axis_bin(at + wide, origin, FRAME_INVERSE(frame), side);
        }
        for (int iz = low[2]; iz <= high[2]; ++iz)
            for (int iy = low[1]; iy <= high[1]; ++iy)
                for (int ix = low[0]; ix <= high[0]; ++ix) {
                    const int bin = shape.s0 + (DIM == 2 ? iy : iz * shape.s2 + iy) * shape.s1 + ix;
                    if (bins[bin].s1 != bins[bin + 1].s1 && n < WAITING) {
                        waiting[n++] = bins[bin].s1;
                        continue;
                    }
                    for (int k = bins[bin].s0; k < bins[bin + 1].s0; ++k) {
                        const REAL4 there = load_vector(graph->points, items[k]) - x;
                        if (sqrt(dot_vectors(there, there)) <= farthest && !visit(seen, items[k]))
                            return false;
                    }
                }
    }
    return true;
}

/* Intersect a piece, relative to x, with old cell j: { y : |y - x_j| <= |y - x_k| for all neighbors k }. Both cells of
   a face compute its plane by the same operations, so that their pieces are complementary. Returns PIECE_*. */
inline int cut_by_cell(private piece_t *piece, REAL4 x, REAL reach, int j, const graph_t *graph)
{
    int what = PIECE_WHOLE;
    const REAL4 xj = load_vector(graph->points, j);
    for (int k = graph->starts[j]; k < graph->starts[j + 1]; ++k) {
        const int q = graph->neighbors[k];
        if (q < 0)
            continue;
        const REAL4 xq = load_vector(graph->points, q);
        const REAL4 low = j < q ? xj : xq, high = j < q ? xq : xj;
        const REAL4 a = low - x, b = high - x;
        REAL4 normal = high - low;
        REAL level = dot_vectors(normal, a + b) / 2;
        const REAL noise = 4 * REAL_EPS * sqrt(dot_vectors(normal, normal));
        const REAL depth = noise * (reach + sqrt(fmax(dot_vectors(a, a), dot_vectors(b, b))));
        if (j > q) {
            normal = -normal;
            level = -level;
        }
        const int cut = cut_piece(piece, normal, level, depth, q);
        if (cut >= PIECE_EMPTY)
            return cut;
        what = cut == PIECE_CUT ? PIECE_CUT : what;
    }
    return what;
}

/* Per new cell i = todo[first + p]: the mean of the old data,

       q_i = sum_j |V_i and V_j| (q_j + g_j . (c_ij - c_j)) / sum_j |V_i and V_j|,

   over the old cells j, with the centroid c_ij of the intersection of V_i and V_j. The old cells are found by flooding:
   first the one that contains x_i, then the neighbors across each face of an intersection. Points of the old graph from
   n_old on have no cells: they are images, or mirror images behind walls. Where the meshes do not cover the same domain
   (`partial`), cells may overlap no old cell; their means are 0. What old cells share with a new one may then lie
   apart: all whose generators are as near as that of an overlapped cell may be are tried.

   means, low, high (n_new, width)   q_i, and bounds of the old data in the cell
   volumes, covered (n_new,)         volume of the cell, sum of the volumes of its intersections
   queues, tables                    capacity and 2 * capacity entries for each work-item */
kernel void transfer_cell_data(const int size, const int first, global const int *todo, const int capacity,
                               global int *queues, global int *tables, GRAPH_ARGS, const int n_old, OLD_GRAPH_ARGS,
                               global const int *items, BIN_ARGS, const REAL4 box_lower, const REAL4 box_upper,
                               const int partial, CELL_DATA_ARGS, global REAL *means, global REAL *low,
                               global REAL *high, global REAL *volumes, global REAL *covered, global int *status)
{
    WORK_ITEM(p);
    const int i = todo[first + p];
    const REAL4 x = load_vector(points, i);
    visited_t seen = {0, capacity, queues + (size_t)p * capacity, tables + (size_t)p * 2 * capacity};
    for (int k = 0; k < 2 * capacity; ++k)
        seen.table[k] = -1;
    piece_t piece;
    shape_t whole;
    int what = build_piece(&piece, i, starts, neighbors, points, box_lower, box_upper);
    if (what != PIECE_WHOLE) {
        status[i] = what == PIECE_FULL ? PIECE_LARGE : FAILED;
        return;
    }
    REAL4 centroid;
    volumes[i] = measure_piece(&piece, &centroid);
    const REAL reach = sqrt(piece.reach2);
    note_piece(&whole, &piece);
    const graph_t old = {old_points, old_starts, old_neighbors};
    const int nearest = nearest_generator(points + (size_t)DIM * i, &old, n_old, items, bins, grid_frames, grid_shapes);
    visit(&seen, nearest);
    const REAL4 way = load_vector(old_points, nearest) - x;
    if (partial) {
        const REAL farthest = (2 * reach + sqrt(dot_vectors(way, way))) * (1 + 16 * REAL_EPS);
        if (!visit_near(&seen, x, farthest, &old, items, BINS)) {
            status[i] = LIST_FULL;
            return;
        }
    }
    for (int c = 0; c < width; ++c) {
        means[(size_t)i * width + c] = 0;
        low[(size_t)i * width + c] = REAL_MAX;
        high[(size_t)i * width + c] = -REAL_MAX;
    }
    REAL sum = 0;
    for (int k = 0; k < seen.n; ++k) {
        const int j = seen.queue[k];
        recall_piece(&piece, &whole);
        what = cut_by_cell(&piece, x, reach, j, &old);
        if (what == PIECE_FULL || what == PIECE_BROKEN) {
            status[i] = what == PIECE_FULL ? PIECE_LARGE : FAILED;
            return;
        }
        bool room = true;
        if (what == PIECE_EMPTY && !partial) {
            /* Round-off may let the search for the first cell stop at a neighbor of it. */
            for (int q = old_starts[j]; sum == 0 && q < old_starts[j + 1]; ++q) {
                const int next = old_neighbors[q];
                if (next >= 0 && next < n_old)
                    room = room && visit(&seen, next);
            }
        }
        if (what != PIECE_EMPTY) {
            const REAL volume = measure_piece(&piece, &centroid);
            const REAL4 off = (x - load_vector(old_points, j)) + centroid - load_vector(centroids, j);
            sum += volume;
            for (int c = 0; c < width; ++c) {
                const size_t from = (size_t)j * width + c, to = (size_t)i * width + c;
                REAL value = values[from];
                if (with_slopes)
                    for (int a = 0; a < DIM; ++a)
                        value += slopes[from * DIM + a] * (a == 0 ? off.s0 : (a == 1 ? off.s1 : off.s2));
                means[to] += volume * value;
                low[to] = fmin(low[to], least[from]);
                high[to] = fmax(high[to], most[from]);
            }
            for (EACH_FACE (&piece, f))
                if (face_label(&piece, f) >= 0 && face_label(&piece, f) < n_old)
                    room = room && visit(&seen, face_label(&piece, f));
        }
        if (!room) {
            status[i] = LIST_FULL;
            return;
        }
    }
    covered[i] = sum;
    for (int c = 0; c < width; ++c)
        means[(size_t)i * width + c] /= sum > 0 ? sum : 1;
    status[i] = sum > 0 || partial ? DONE : FAILED;
}

/* Solve M g = b for a symmetric positive semidefinite M by elimination with the largest pivot first. Overwrites M, and
   b with g. Returns false and leaves b unchanged if M is singular to round-off. */
inline bool solve_by_elimination(REAL m[DIM][DIM], REAL *b)
{
    int order[DIM];
    REAL x[DIM], scale = 0;
    bool used[DIM];
    for (int a = 0; a < DIM; ++a) {
        used[a] = false;
        x[a] = b[a];
        scale = fmax(scale, m[a][a]);
    }
    for (int rank = 0; rank < DIM; ++rank) {
        int p = -1;
        for (int a = 0; a < DIM; ++a)
            if (!used[a] && (p < 0 || m[a][a] > m[p][p]))
                p = a;
        if (!(m[p][p] > 256 * REAL_EPS * scale))
            return false;
        used[p] = true;
        order[rank] = p;
        for (int a = 0; a < DIM; ++a) {
            if (used[a])
                continue;
            const REAL factor = m[a][p] / m[p][p];
            for (int c = 0; c < DIM; ++c)
                m[a][c] -= factor * m[p][c];
            x[a] -= factor * x[p];
        }
    }
    for (int r = DIM - 1; r >= 0; --r) {
        const int p = order[r];
        REAL sum = x[p];
        for (int later = r + 1; later < DIM; ++later)
            sum -= m[p][order[later]] * b[order[later]];
        b[p] = sum / m[p][p];
    }
    return true;
}

/* Solve the normal equations M g = b; overwrite b with g. If M is singular, as for a cell in a corner of the box with
   one neighbor, return the solution of least norm, accurate to the square root of the machine epsilon. */
inline void solve_normal_equations(REAL m[DIM][DIM], REAL *b)
{
    REAL copy[DIM][DIM], trace = 0;
    for (int a = 0; a < DIM; ++a) {
        trace += m[a][a];
        for (int c = 0; c < DIM; ++c)
            copy[a][c] = m[a][c];
    }
    if (solve_by_elimination(copy, b))
        return;
    for (int a = 0; a < DIM; ++a)
        for (int c = 0; c < DIM; ++c)
            copy[a][c] = m[a][c] + (a == c ? sqrt(REAL_EPS) * trace : 0);
    if (!(trace > 0) || !solve_by_elimination(copy, b))
        for (int a = 0; a < DIM; ++a)
            b[a] = 0;
}

/* Per cell j, for each column c: the slope g_j of the least-squares fit to the neighbors k,

       min over g of sum_k w_k (q_k - q_j - g . (c_k - c_j))^2,   w_k = 1 / |c_k - c_j|^2,

   and least, most: the extremes of q over j and its neighbors. With `limited`, g_j is multiplied by the largest factor
   <= 1 that keeps the linear function within these bounds at all corners v of the cell (T. J. Barth and D. C.
   Jespersen, The design and application of upwind schemes on unstructured meshes, AIAA 89-0366, 1989):

       min over v of (most - q_j) / r if r > 0, (least - q_j) / r if r < 0,   r = g . (v - c_j). */
kernel void fit_slopes(const int size, const int width, GRAPH_ARGS, const REAL4 box_lower, const REAL4 box_upper,
                       global const REAL *centroids, global const REAL *values, const int limited, global REAL *slopes,
                       global REAL *least, global REAL *most, global int *status)
{
    WORK_ITEM(j);
    const REAL4 x = load_vector(points, j), cj = load_vector(centroids, j);
    piece_t cell;
    const int what = build_piece(&cell, j, starts, neighbors, points, box_lower, box_upper);
    status[j] = what == PIECE_WHOLE ? DONE : (what == PIECE_FULL ? PIECE_LARGE : FAILED);
    if (what != PIECE_WHOLE)
        return;
    for (int c = 0; c < width; ++c) {
        const REAL own = values[(size_t)j * width + c];
        REAL m[DIM][DIM], g[DIM], bottom = own, top = own;
        for (int a = 0; a < DIM; ++a) {
            g[a] = 0;
            for (int b = 0; b < DIM; ++b)
                m[a][b] = 0;
        }
        for (int k = starts[j]; k < starts[j + 1]; ++k) {
            const int q = neighbors[k];
            if (q < 0 || q >= size)
                continue;
            const REAL there = values[(size_t)q * width + c];
            const REAL4 d4 = (load_vector(points, q) - x) + (load_vector(centroids, q) - cj);
            const REAL d[3] = {d4.s0, d4.s1, d4.s2};
            const REAL weight = 1 / dot_vectors(d4, d4);
            bottom = fmin(bottom, there);
            top = fmax(top, there);
            for (int a = 0; a < DIM; ++a) {
                g[a] += weight * (there - own) * d[a];
                for (int b = 0; b < DIM; ++b)
                    m[a][b] += weight * d[a] * d[b];
            }
        }
        solve_normal_equations(m, g);
        REAL factor = 1;
        for (int v = 0; limited && v < corner_count(&cell); ++v) {
            const REAL4 off = corner_of(&cell, v) - cj;
            REAL rise = g[0] * off.s0 + g[1] * off.s1;
#if DIM == 3
            rise += g[2] * off.s2;
#endif
            const REAL room = rise > 0 ? top - own : bottom - own;
            if (fabs(rise) > fabs(room))
                factor = fmin(factor, room / rise);
        }
        for (int a = 0; a < DIM; ++a)
            slopes[((size_t)j * width + c) * DIM + a] = factor * g[a];
        least[(size_t)j * width + c] = bottom;
        most[(size_t)j * width + c] = top;
    }
}
