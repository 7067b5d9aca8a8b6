/* Building blocks of size fields. The host writes `size_at` as calls of these functions and puts it, with this file, in
   front of every kernel that needs h (clvoro/sizing/codegen.py). No other header is included before: only DIM and REAL
   are defined. Lengths and coordinates are normalized, x' = (x - origin) / scale. */
#pragma OPENCL FP_CONTRACT OFF
#if defined(__OPENCL_C_VERSION__) && __OPENCL_C_VERSION__ < 120 && defined(cl_khr_fp64)
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif

#define SIZE_JOIN_(a, b) a##b
#define SIZE_JOIN(a, b) SIZE_JOIN_(a, b)
#define SIZE_LARGEST_double DBL_MAX
#define SIZE_LARGEST_float FLT_MAX
#define SIZE_LARGEST SIZE_JOIN(SIZE_LARGEST_, REAL)

/* Unlike fmin and fmax, these return NaN if an argument is NaN, so that the check of sizes finds it. */
REAL size_min(REAL a, REAL b)
{
    return (a < b || a != a) ? a : b;
}

REAL size_max(REAL a, REAL b)
{
    return (a > b || a != a) ? a : b;
}

/* Multilinear interpolation between the nodes of a grid; outside of it, the value of the nearest edge.
   data: gain (DIM), shift (DIM), then values with x running fastest; the index coordinate is gain * x + shift. */
REAL size_raster(const REAL *x, __global const REAL *data, int nx, int ny, int nz)
{
    const int count[3] = {nx, ny, nz};
    __global const REAL *values = data + 2 * DIM;
    int base = 0, stride = 1, step[DIM];
    REAL weight[DIM];
    for (int a = 0; a < DIM; ++a) {
        const REAL t = clamp(data[a] * x[a] + data[DIM + a], (REAL)0, (REAL)(count[a] - 1));
        const int i = min((int)t, max(count[a] - 2, 0));
        weight[a] = t - (REAL)i;
        step[a] = count[a] > 1 ? stride : 0;
        base += i * stride;
        stride *= count[a];
    }
    REAL sum = 0;
    for (int corner = 0; corner < (1 << DIM); ++corner) {
        int at = base;
        REAL w = 1;
        for (int a = 0; a < DIM; ++a) {
            const int far = (corner >> a) & 1;
            w *= far ? weight[a] : 1 - weight[a];
            at += far ? step[a] : 0;
        }
        sum += w * values[at];
    }
    return sum;
}

/* An item is the set of points at distance r from the segment a + t d, 0 <= t <= 1: a segment has r = 0, a circle d =
   0. Stored as a (DIM), d (DIM), 1/|d|^2 (0 for a point), r. Distances are to the curve, from both sides. */
#define SIZE_ITEM (2 * DIM + 2)

/* Squared distance to the segment, without r. */
REAL size_segment_distance2(const REAL *x, __global const REAL *item)
{
    REAL v[DIM], t = 0, sum = 0;
    for (int a = 0; a < DIM; ++a) {
        v[a] = x[a] - item[a];
        t += v[a] * item[DIM + a];
    }
    t = fmin(fmax(t * item[2 * DIM], (REAL)0), (REAL)1);
    for (int a = 0; a < DIM; ++a) {
        v[a] -= t * item[DIM + a];
        sum += v[a] * v[a];
    }
    return sum;
}

/* A triangle a, b, c: a (3), its sides b - a and c - a (3 each), the vectors whose products with x - a are the
   coordinates s and t of a + s (b - a) + t (c - a) (3 each), the unit normal (3; 0 for a degenerate triangle, which is
   treated as its sides), 1 / length^2 of b - a, c - a and c - b (0 for a point). */
#define SIZE_TRIANGLE 21

#if DIM == 3
REAL size_dot(const REAL *a, __global const REAL *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Squared distance to a side, from v = x - begin, its vector d and 1 / |d|^2. */
REAL size_side_distance2(const REAL *v, const REAL *d, REAL inverse)
{
    REAL t = v[0] * d[0] + v[1] * d[1] + v[2] * d[2], sum = 0;
    t = fmin(fmax(t * inverse, (REAL)0), (REAL)1);
    for (int a = 0; a < 3; ++a) {
        const REAL w = v[a] - t * d[a];
        sum += w * w;
    }
    return sum;
}

/* Squared distance to a triangle. If the foot of the perpendicular lies inside (s, t >= 0, s + t <= 1), it is the
   nearest point. Otherwise the nearest point is on a side that the foot is beyond: the vector from the nearest point to
   the foot is a sum of outward normals of the sides there. */
REAL size_triangle_distance2(const REAL *x, __global const REAL *item)
{
    REAL v[3], side[3], best2 = SIZE_LARGEST;
    for (int a = 0; a < 3; ++a)
        v[a] = x[a] - item[a];
    const REAL s = size_dot(v, item + 9), t = size_dot(v, item + 12);
    const int thin = item[15] == 0 && item[16] == 0 && item[17] == 0;
    if (!thin && s >= 0 && t >= 0 && s + t <= 1) {
        const REAL height = size_dot(v, item + 15);
        return height * height;
    }
    if (thin || s + t > 1) {
        REAL w[3];
        for (int a = 0; a < 3; ++a) {
            side[a] = item[6 + a] - item[3 + a];
            w[a] = v[a] - item[3 + a];
        }
        best2 = size_side_distance2(w, side, item[20]);
    }
    if (thin || t < 0) {
        for (int a = 0; a < 3; ++a)
            side[a] = item[3 + a];
        best2 = fmin(best2, size_side_distance2(v, side, item[18]));
    }
    if (thin || s < 0) {
        for (int a = 0; a < 3; ++a)
            side[a] = item[6 + a];
        best2 = fmin(best2, size_side_distance2(v, side, item[19]));
    }
    return best2;
}
#endif

/* Kinds of items. The argument `kind` is a literal, so that only one branch is compiled. */
#define SIZE_STRAIGHT 0
#define SIZE_ROUND 1
#define SIZE_FLAT 2

REAL size_item_distance2(const REAL *x, __global const REAL *items, int i, int kind)
{
#if DIM == 3
    if (kind == SIZE_FLAT)
        return size_triangle_distance2(x, items + i * SIZE_TRIANGLE);
#endif
    __global const REAL *item = items + i * SIZE_ITEM;
    const REAL d2 = size_segment_distance2(x, item);
    if (kind == SIZE_STRAIGHT)
        return d2;
    const REAL d = sqrt(d2) - item[2 * DIM + 1];
    return d * d;
}

/* The minimum of best2 and of the squared distances to n items, without a tree. data: the items. */
REAL size_nearest_few(const REAL *x, __global const REAL *data, int n, int kind, REAL best2)
{
    for (int i = 0; i < n; ++i)
        best2 = fmin(best2, size_item_distance2(x, data, i, kind));
    return best2;
}

/* h = min(h_min + slope distance, h_max). law: h_min, slope, h_max, and the square of the distance at which h reaches
   h_max, where searches start. */
REAL size_of_distance(REAL distance2, __global const REAL *law)
{
    return fmin(law[0] + law[1] * sqrt(distance2), law[2]);
}

REAL size_box_distance2(const REAL *x, __global const REAL *box)
{
    REAL sum = 0;
    for (int a = 0; a < DIM; ++a) {
        const REAL v = fmax(fmax(box[a] - x[a], x[a] - box[DIM + a]), (REAL)0);
        sum += v * v;
    }
    return sum;
}

/* The same with a binary tree of bounding boxes and 2^levels leaves: leaf l holds the items
   [l n / 2^levels, (l + 1) n / 2^levels), node k has the children 2 k + 1 and 2 k + 2. The nearer child is visited
   first; boxes farther than the best distance so far are skipped.
   data: the boxes (lower, upper) of 2^(levels + 1) - 1 nodes, the items. */
REAL size_nearest_tree(const REAL *x, __global const REAL *data, int n, int levels, int kind, REAL best2)
{
    __global const REAL *boxes = data;
    const int first_leaf = (1 << levels) - 1;
    __global const REAL *items = boxes + (2 * first_leaf + 1) * 2 * DIM;
    int waiting[24], top = 0, node = 0;
    REAL bound2[24];
    for (;;) {
        if (node < first_leaf) {
            int near = 2 * node + 1, far = near + 1;
            REAL near2 = size_box_distance2(x, boxes + near * 2 * DIM);
            REAL far2 = size_box_distance2(x, boxes + far * 2 * DIM);
            if (far2 < near2) {
                const REAL swap = near2;
                near2 = far2;
                far2 = swap;
                far = near;
                near = far + 1;
            }
            if (far2 < best2) {
                waiting[top] = far;
                bound2[top++] = far2;
            }
            if (near2 < best2) {
                node = near;
                continue;
            }
        } else {
            const long leaf = node - first_leaf;
            const int end = (int)(((leaf + 1) * n) >> levels);
            for (int i = (int)((leaf * n) >> levels); i < end; ++i)
                best2 = fmin(best2, size_item_distance2(x, items, i, kind));
        }
        do {
            if (top == 0)
                return best2;
            --top;
        } while (!(bound2[top] < best2));
        node = waiting[top];
    }
}

#if DIM == 3
/* Round regions on the unit sphere. data: h_max, slope, then per region its center (3), radius and size. */
REAL size_of_caps(const REAL *x, __global const REAL *data, int count)
{
    REAL h = data[0];
    for (int k = 0; k < count; ++k) {
        __global const REAL *cap = data + 2 + 5 * k;
        REAL chord2 = 0;
        for (int a = 0; a < 3; ++a) {
            const REAL d = x[a] - cap[a];
            chord2 += d * d;
        }
        const REAL away = 2 * asin(fmin(sqrt(chord2) / 2, (REAL)1));
        h = size_min(h, cap[4] + data[1] * fmax(away - cap[3], (REAL)0));
    }
    return h;
}
#endif

/* Items of closed boundaries: segments a, b in 2D, triangles a, b, c in 3D. */
#define SIZE_CORNERS (DIM * DIM)

/* Whether the line through (u, v) along u crosses the segment from a to b at more than u. Ends are taken in one order,
   so that a segment gives the same answer in all items that have it; of a chain each end counts once. */
int size_line_crosses(REAL u, REAL v, REAL au, REAL av, REAL bu, REAL bv)
{
    if ((av > v) == (bv > v))
        return 0;
    const int turn = av > bv;
    const REAL pu = turn ? bu : au, pv = turn ? bv : av, qu = turn ? au : bu, qv = turn ? av : bv;
    return u < (qu - pu) * (v - pv) / (qv - pv) + pu;
}

/* Whether the ray from x along the first axis meets an item. */
int size_ray_meets(const REAL *x, __global const REAL *e)
{
#if DIM == 2
    return size_line_crosses(x[0], x[1], e[0], e[1], e[2], e[3]);
#else
    int inside = 0;
    for (int k = 0; k < 3; ++k) {
        __global const REAL *a = e + 3 * k, *b = e + 3 * ((k + 1) % 3);
        inside ^= size_line_crosses(x[1], x[2], a[1], a[2], b[1], b[2]);
    }
    if (!inside)
        return 0;
    REAL s[3], t[3];
    for (int a = 0; a < 3; ++a) {
        s[a] = e[3 + a] - e[a];
        t[a] = e[6 + a] - e[a];
    }
    const REAL nx = s[1] * t[2] - s[2] * t[1], ny = s[2] * t[0] - s[0] * t[2], nz = s[0] * t[1] - s[1] * t[0];
    return nx != 0 && x[0] < e[0] - (ny * (x[1] - e[1]) + nz * (x[2] - e[2])) / nx;
#endif
}

/* Whether x is inside of closed boundaries: the ray meets them an odd number of times. The tree is that of
   size_nearest_tree. */
int size_inside(const REAL *x, __global const REAL *data, int n, int levels)
{
    const int first_leaf = (1 << levels) - 1;
    __global const REAL *items = data + (2 * first_leaf + 1) * 2 * DIM;
    int waiting[24], top = 0, inside = 0;
    waiting[top++] = 0;
    while (top > 0) {
        const int node = waiting[--top];
        __global const REAL *box = data + node * 2 * DIM;
        int apart = x[0] > box[DIM];
        for (int a = 1; a < DIM; ++a)
            apart |= x[a] < box[a] || x[a] > box[DIM + a];
        if (apart)
            continue;
        if (node < first_leaf) {
            waiting[top++] = 2 * node + 1;
            waiting[top++] = 2 * node + 2;
            continue;
        }
        const long leaf = node - first_leaf;
        const int end = (int)(((leaf + 1) * n) >> levels);
        for (int i = (int)((leaf * n) >> levels); i < end; ++i)
            inside ^= size_ray_meets(x, items + i * SIZE_CORNERS);
    }
    return inside;
}

/* A field from the data of cells (clvoro/sizing/cells.py). data: axis and coordinate of each inner node of a k-d tree
   whose leaves are all `levels` deep; then for each cell its centroid (DIM), value, least and largest value, and slope
   (DIM), leaf by leaf.

   The linear functions of all cells with r_j^2 < 2 r^2, r the distance of the nearest centroid, are blended with the
   weights (1 - 3 (r_j^2 - r^2) / (r_j^2 + r^2))^2: the first pass finds r, the second one sums. */
#define SIZE_CELL (2 * DIM + 3)
#define SIZE_MOST_LEVELS 32
REAL size_on_cells(const REAL *x, __global const REAL *data, int n, int levels)
{
    const int leaves = 1 << levels;
    __global const REAL *cells = data + 2 * (leaves - 1);
    REAL nearest = SIZE_LARGEST, sum = 0, total = 0;
    for (int pass = 0; pass < 2; ++pass) {
        int pending[SIZE_MOST_LEVELS], count = 1;
        REAL gaps[SIZE_MOST_LEVELS];
        pending[0] = 1;
        gaps[0] = 0;
        while (count > 0) {
            int node = pending[--count];
            REAL gap = gaps[count];
            if (gap > (pass ? 2 * nearest : nearest))
                continue;
            while (node < leaves) {
                const REAL beyond = x[(int)data[2 * (node - 1)]] - data[2 * (node - 1) + 1];
                const int right = beyond > 0;
                pending[count] = 2 * node + 1 - right;
                gaps[count++] = fmax(gap, beyond * beyond);
                node = 2 * node + right;
            }
            const long leaf = node - leaves;
            for (int c = (int)((leaf * n) >> levels); c < (int)(((leaf + 1) * n) >> levels); ++c) {
                __global const REAL *cell = cells + c * SIZE_CELL;
                REAL apart2 = 0, value = cell[DIM];
                for (int a = 0; a < DIM; ++a) {
                    const REAL v = x[a] - cell[a];
                    apart2 += v * v;
                    value += cell[DIM + 3 + a] * v;
                }
                if (!pass) {
                    nearest = fmin(nearest, apart2);
                } else if (apart2 <= 2 * nearest) {
                    const REAL far = apart2 > nearest ? 3 * (apart2 - nearest) / (apart2 + nearest) : 0;
                    const REAL weight = far < 1 ? (1 - far) * (1 - far) : 0;
                    sum += weight * fmin(fmax(value, cell[DIM + 1]), cell[DIM + 2]);
                    total += weight;
                }
            }
        }
    }
    return sum / total;
}
