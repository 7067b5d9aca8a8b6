#include "opencl/real.h"
#include "remapping/piece.h"

/* Outcomes of a piece. */
#define DONE 0
#define PIECE_LARGE 1 /* it has more faces than its arrays hold */
#define FAILED 2      /* it is no cell of a Voronoi diagram */

inline int outcome(int what)
{
    return what == PIECE_WHOLE ? DONE : (what == PIECE_FULL ? PIECE_LARGE : FAILED);
}

/* Per piece: volume; centroid, on a sphere the mean of the position in space; and a box around it. */
kernel void measure_pieces(const int size, PIECES_ARGS, const REAL4 box_lower, const REAL4 box_upper,
                           global REAL *volumes, global REAL *centroids, global REAL *lower, global REAL *upper,
                           global int *status)
{
    WORK_ITEM(i);
    const pieces_t mesh = {origins, points, starts, items};
    const chart_t chart = chart_at(origins, i);
    piece_t piece;
    const int what = build_piece(&piece, &chart, i, &mesh, box_lower, box_upper);
    status[i] = outcome(what);
    if (what != PIECE_WHOLE)
        return;
    REAL4 centroid, low, high;
    volumes[i] = measure_piece(&piece, &chart, &centroid);
    bound_piece(&piece, &chart, &low, &high);
    store_vector(chart.at + centroid, centroids, i);
    store_vector(low, lower, i);
    store_vector(high, upper, i);
}

/* Data of the old mesh, `width` columns.

   cells (pieces)           the cell that each piece is a part of
   values (n, width)        means q_j over the cells
   least, most (n, width)   bounds of the data inside a cell
   means (n, DIM)           c_j, centroids; on a sphere means of the position in space
   slopes (n, width, DIM)   g_j; not read unless with_slopes */
#define CELL_DATA_ARGS                                                                                                 \
    global const int *cells, const int width, global const REAL *values, global const REAL *least,                     \
        global const REAL *most, global const REAL *means, const int with_slopes, global const REAL *slopes

/* Old pieces in a binary tree of 2^levels leaves. Node k has the children 2 k + 1 and 2 k + 2. Leaf l holds the entries
   [l n / 2^levels, (l + 1) n / 2^levels).

   boxes (nodes, 2 DIM)     lower and upper corner
   entries (n, 2)           a piece, and the image of it
   shifts (images, DIM)     from a piece to its image across seams */
#define TREE_ARGS                                                                                                      \
    const int entries_count, const int levels, global const REAL *boxes, global const int *entries,                    \
        global const REAL *shifts
/* Boxes that are less apart than this, in units of the domain, meet. */
#define BOX_NOISE (16 * REAL_EPS)

inline bool meets_box(REAL4 lower, REAL4 upper, global const REAL *box)
{
    const REAL4 low = load_vector(box, 0), high = load_vector(box, 1);
    return lower.s0 <= high.s0 + BOX_NOISE && low.s0 <= upper.s0 + BOX_NOISE && lower.s1 <= high.s1 + BOX_NOISE &&
           low.s1 <= upper.s1 + BOX_NOISE && lower.s2 <= high.s2 + BOX_NOISE && low.s2 <= upper.s2 + BOX_NOISE;
}

/* Make `piece` what old piece j, moved by `shift`, leaves of `whole`. Returns PIECE_*. */
inline int intersect(private piece_t *piece, private const shape_t *whole, const chart_t *chart, REAL reach,
                     const pieces_t *old, int j, REAL4 shift)
{
    const int begin = old->starts[j], end = old->starts[j + 1];
    ulong cutting = 0; /* of the first 64 half-spaces those that cut the whole piece */
    REAL level;
    for (int k = begin; k < end; ++k) {
        const REAL4 normal = half_space(chart, reach, old, j, k, shift, &level);
        /* Most are far from the ball around the piece. */
        if (level * level > R(1.01) * reach * reach * dot_vectors(normal, normal)) {
            if (level < 0)
                return PIECE_EMPTY;
            continue;
        }
        const int beyond = count_beyond(whole, normal, level);
        if (beyond == whole->n)
            return PIECE_EMPTY;
        cutting |= beyond > 0 && k - begin < 64 ? (ulong)1 << (k - begin) : 0;
    }
    recall_piece(piece, whole);
    for (int k = begin; k < end; ++k) {
        if (k - begin < 64 && !(cutting >> (k - begin) & 1))
            continue;
        const REAL4 normal = half_space(chart, reach, old, j, k, shift, &level);
        const int cut = cut_piece(piece, normal, level);
        if (cut >= PIECE_EMPTY)
            return cut;
    }
    return PIECE_CUT;
}

/* Per new piece i = todo[p]: the integral of the old data,

       m_i = sum_j |V_i and V_j| (q_j + g_j . (c_ij - c_j)),

   over the old pieces j and their images, with the centroid c_ij of the intersection of V_i and V_j. Candidates are
   those whose boxes meet that of the piece.

   masses, low, high (pieces, width)   m_i, and bounds of the old data in the piece
   volumes, covered (pieces,)          volume of the piece, sum of the volumes of its intersections */
kernel void transfer_cell_data(const int size, global const int *todo, PIECES_ARGS, OLD_PIECES_ARGS, TREE_ARGS,
                               const REAL4 box_lower, const REAL4 box_upper, CELL_DATA_ARGS, global REAL *masses,
                               global REAL *low, global REAL *high, global REAL *volumes, global REAL *covered,
                               global int *status)
{
    WORK_ITEM(p);
    const int i = todo[p];
    const pieces_t mesh = {origins, points, starts, items}, old = {old_origins, old_points, old_starts, old_items};
    const chart_t chart = chart_at(origins, i);
    piece_t piece;
    shape_t whole;
    const int built = build_piece(&piece, &chart, i, &mesh, box_lower, box_upper);
    status[i] = outcome(built);
    if (built != PIECE_WHOLE)
        return;
    REAL4 lower, upper, centroid;
    bound_piece(&piece, &chart, &lower, &upper);
    volumes[i] = measure_piece(&piece, &chart, &centroid);
    note_piece(&whole, &piece);
    REAL reach2 = 0;
    for (int k = 0; k < piece.n; ++k) {
        const REAL4 corner = corner_of(&piece, k);
        reach2 = fmax(reach2, corner.s0 * corner.s0 + corner.s1 * corner.s1 + corner.s2 * corner.s2);
    }
    const REAL reach = sqrt(reach2);
    for (int c = 0; c < width; ++c) {
        masses[(size_t)i * width + c] = 0;
        low[(size_t)i * width + c] = REAL_MAX;
        high[(size_t)i * width + c] = -REAL_MAX;
    }
    const int first_leaf = (1 << levels) - 1;
    REAL sum = 0;
    int node = 0;
    do {
        if (meets_box(lower, upper, boxes + (size_t)node * 2 * DIM)) {
            if (node < first_leaf) {
                node = 2 * node + 1;
                continue;
            }
            const long leaf = node - first_leaf;
            const int end = (int)(((leaf + 1) * entries_count) >> levels);
            for (int entry = (int)((leaf * entries_count) >> levels); entry < end; ++entry) {
                const int j = entries[2 * entry], cell = cells[j];
                const REAL4 shift = load_vector(shifts, entries[2 * entry + 1]);
                const int what = intersect(&piece, &whole, &chart, reach, &old, j, shift);
                if (what == PIECE_EMPTY)
                    continue;
                if (what != PIECE_CUT) {
                    status[i] = outcome(what);
                    return;
                }
                const REAL volume = measure_piece(&piece, &chart, &centroid);
                if (!(volume > 0))
                    continue;
                const REAL4 off = chart.at - shift - load_vector(means, cell) + centroid;
                sum += volume;
                for (int c = 0; c < width; ++c) {
                    const size_t from = (size_t)cell * width + c, to = (size_t)i * width + c;
                    REAL value = values[from];
                    if (with_slopes)
                        value += dot_vectors(load_vector(slopes, from), off);
                    masses[to] += volume * value;
                    low[to] = fmin(low[to], least[from]);
                    high[to] = fmax(high[to], most[from]);
                }
            }
        }
        /* A right child is the last one of its parent. */
        while (node > 0 && node % 2 == 0)
            node = (node - 1) / 2;
        node += node > 0;
    } while (node > 0);
    covered[i] = sum;
}

/* Solve M g = b for a symmetric positive semidefinite M by elimination with the largest pivot first. Overwrites M, and
   b with g. Returns false and leaves b unchanged if M is singular to round-off. */
inline bool solve_by_elimination(REAL m[CELL_DIM][CELL_DIM], REAL *b)
{
    int order[CELL_DIM];
    REAL x[CELL_DIM], scale = 0;
    bool used[CELL_DIM];
    for (int a = 0; a < CELL_DIM; ++a) {
        used[a] = false;
        x[a] = b[a];
        scale = fmax(scale, m[a][a]);
    }
    for (int rank = 0; rank < CELL_DIM; ++rank) {
        int p = -1;
        for (int a = 0; a < CELL_DIM; ++a)
            if (!used[a] && (p < 0 || m[a][a] > m[p][p]))
                p = a;
        if (!(m[p][p] > 256 * REAL_EPS * scale))
            return false;
        used[p] = true;
        order[rank] = p;
        for (int a = 0; a < CELL_DIM; ++a) {
            if (used[a])
                continue;
            const REAL factor = m[a][p] / m[p][p];
            for (int c = 0; c < CELL_DIM; ++c)
                m[a][c] -= factor * m[p][c];
            x[a] -= factor * x[p];
        }
    }
    for (int r = CELL_DIM - 1; r >= 0; --r) {
        const int p = order[r];
        REAL sum = x[p];
        for (int later = r + 1; later < CELL_DIM; ++later)
            sum -= m[p][order[later]] * b[order[later]];
        b[p] = sum / m[p][p];
    }
    return true;
}

/* Solve the normal equations M g = b; overwrite b with g. If M is singular, as for a cell in a corner of the box with
   one neighbor, return the solution of least norm, accurate to the square root of the machine epsilon. */
inline void solve_normal_equations(REAL m[CELL_DIM][CELL_DIM], REAL *b)
{
    REAL copy[CELL_DIM][CELL_DIM], trace = 0;
    for (int a = 0; a < CELL_DIM; ++a) {
        trace += m[a][a];
        for (int c = 0; c < CELL_DIM; ++c)
            copy[a][c] = m[a][c];
    }
    if (solve_by_elimination(copy, b))
        return;
    for (int a = 0; a < CELL_DIM; ++a)
        for (int c = 0; c < CELL_DIM; ++c)
            copy[a][c] = m[a][c] + (a == c ? sqrt(REAL_EPS) * trace : 0);
    if (!(trace > 0) || !solve_by_elimination(copy, b))
        for (int a = 0; a < CELL_DIM; ++a)
            b[a] = 0;
}

/* Per cell j, for each column c: the slope g_j of the least-squares fit to the neighbors k,

       min over g of sum_k w_k (q_k - q_j - g . (c_k - c_j))^2,   w_k = 1 / |c_k - c_j|^2,

   and least, most: the extremes of q over j and its neighbors. With `limited`, g_j is multiplied by the largest factor
   <= 1 that keeps the linear function within these bounds at all corners v of the cell (T. J. Barth and D. C.
   Jespersen, The design and application of upwind schemes on unstructured meshes, AIAA 89-0366, 1989):

       min over v of (most - q_j) / r if r > 0, (least - q_j) / r if r < 0,   r = g . (v - c_j).

   On a sphere g_j lies in the tangent plane of the cell's origin.

   parts (n + 1,)           the pieces of cell j are parts[j] to parts[j + 1]
   rows, neighbors          the graph of the cells; negative entries are walls
   seams (m, DIM)           the neighbor is the image that many `periods` away */
kernel void fit_slopes(const int size, const int width, global const int *parts, PIECES_ARGS, global const int *rows,
                       global const int *neighbors, global const char *seams, const REAL4 periods,
                       const REAL4 box_lower, const REAL4 box_upper, global const REAL *means,
                       global const REAL *values, const int limited, global REAL *slopes, global REAL *least,
                       global REAL *most, global int *status)
{
    WORK_ITEM(j);
    const pieces_t mesh = {origins, points, starts, items};
    const REAL4 cj = load_vector(means, j);
    status[j] = DONE;
    piece_t piece;
    for (int c = 0; c < width; ++c) {
        const size_t at = (size_t)j * width + c;
        const REAL own = values[at];
        REAL m[CELL_DIM][CELL_DIM], g[CELL_DIM], bottom = own, top = own;
        for (int a = 0; a < CELL_DIM; ++a) {
            g[a] = 0;
            for (int b = 0; b < CELL_DIM; ++b)
                m[a][b] = 0;
        }
#ifdef SPHERE
        const chart_t tangents = chart_at(origins, min(parts[j], parts[size] - 1));
#endif
        for (int k = rows[j]; k < rows[j + 1]; ++k) {
            const int q = neighbors[k];
            if (q < 0)
                continue;
            const REAL there = values[(size_t)q * width + c];
            const REAL4 seam = (REAL4)(seams[DIM * k], seams[DIM * k + 1], DIM == 3 ? seams[DIM * k + DIM - 1] : 0, 0);
            const REAL4 way = load_vector(means, q) - cj + seam * periods;
#ifdef SPHERE
            const REAL d[2] = {dot_vectors(way, tangents.one), dot_vectors(way, tangents.other)};
#else
            const REAL d[3] = {way.s0, way.s1, way.s2};
#endif
            REAL d2 = 0;
            for (int a = 0; a < CELL_DIM; ++a)
                d2 += d[a] * d[a];
            if (!(d2 > 0))
                continue;
            bottom = fmin(bottom, there);
            top = fmax(top, there);
            for (int a = 0; a < CELL_DIM; ++a) {
                g[a] += (there - own) / d2 * d[a];
                for (int b = 0; b < CELL_DIM; ++b)
                    m[a][b] += d[a] * d[b] / d2;
            }
        }
        solve_normal_equations(m, g);
        REAL factor = 1;
        for (int i = parts[j]; limited && i < parts[j + 1]; ++i) {
            const chart_t chart = chart_at(origins, i);
            const int what = build_piece(&piece, &chart, i, &mesh, box_lower, box_upper);
            if (what != PIECE_WHOLE) {
                status[j] = outcome(what);
                return;
            }
            const REAL4 from = cj - chart.at;
            for (int v = 0; v < piece.n; ++v) {
                REAL4 corner = corner_of(&piece, v);
#ifdef SPHERE
                corner /= sqrt(1 + corner.s0 * corner.s0 + corner.s1 * corner.s1);
                const REAL4 off = corner - (REAL4)(dot_vectors(from, chart.one), dot_vectors(from, chart.other), 0, 0);
#else
                const REAL4 off = corner - from;
#endif
                REAL rise = g[0] * off.s0 + g[1] * off.s1;
#if CELL_DIM == 3
                rise += g[2] * off.s2;
#endif
                const REAL room = rise > 0 ? top - own : bottom - own;
                if (fabs(rise) > fabs(room))
                    factor = fmin(factor, room / rise);
            }
        }
#ifdef SPHERE
        store_vector(factor * (g[0] * tangents.one + g[1] * tangents.other), slopes, at);
#else
        for (int a = 0; a < DIM; ++a)
            slopes[at * DIM + a] = factor * g[a];
#endif
        least[at] = bottom;
        most[at] = top;
    }
}
