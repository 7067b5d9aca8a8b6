/* The bricks of a size field. The host writes `size_at` out of calls to these functions and puts it, with this file,
   in front of any kernel that needs h (clvoro/sizing/bind.py), so nothing here may lean on another header: only
   DIM and REAL are known. Lengths and coordinates are the normalised ones, x' = (x - origin) / scale. */
#pragma OPENCL FP_CONTRACT OFF
#if defined(__OPENCL_C_VERSION__) && __OPENCL_C_VERSION__ < 120 && defined(cl_khr_fp64)
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif

/* Unlike fmin and fmax these hand a NaN on, so that a broken branch is seen and refused. */
REAL size_min(REAL a, REAL b)
{
    return (a < b || a != a) ? a : b;
}

REAL size_max(REAL a, REAL b)
{
    return (a > b || a != a) ? a : b;
}

/* Multilinear interpolation between the nodes of a grid; outside, the value of the nearest edge.
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

/* An item is a segment a + t d, 0 <= t <= 1, blown up to radius r: a segment has r = 0, a circle d = 0.
   Stored as a (DIM), d (DIM), 1/|d|^2 (0 for a point), r. The distance is to the curve, from both sides. */
#define SIZE_ITEM (2 * DIM + 2)

/* Squared distance to the segment alone: no square root as long as all r are 0. */
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

REAL size_item_distance2(const REAL *x, __global const REAL *item, int round)
{
    const REAL d2 = size_segment_distance2(x, item);
    if (!round)
        return d2;
    const REAL d = sqrt(d2) - item[2 * DIM + 1];
    return d * d;
}

/* h = min(h_min + slope * distance, h_max), the law all distances end in. law: h_min, slope, h_max. */
REAL size_law(REAL distance2, __global const REAL *law)
{
    return fmin(law[0] + law[1] * sqrt(distance2), law[2]);
}

/* The distance to the nearest of n items, by looking at all. `round` tells whether some have r > 0.
   data: the law, the items. */
REAL size_distance_few(const REAL *x, __global const REAL *data, int n, int round)
{
    REAL best2 = size_item_distance2(x, data + 3, round);
    for (int i = 1; i < n; ++i)
        best2 = fmin(best2, size_item_distance2(x, data + 3 + i * SIZE_ITEM, round));
    return size_law(best2, data);
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

/* The same through a binary tree of bounding boxes with 2^levels leaves: leaf l holds the items
   [l n / 2^levels, (l + 1) n / 2^levels), node k has the children 2 k + 1 and 2 k + 2. The nearer child is visited
   first; a box that is farther than the best item found so far is skipped, and so is everything beyond the
   distance at which h_max takes over.
   data: the law, the square of that distance, the boxes (lower, upper) of 2^(levels + 1) - 1 nodes, the items. */
REAL size_distance_tree(const REAL *x, __global const REAL *data, int n, int levels, int round)
{
    __global const REAL *boxes = data + 4;
    const int first_leaf = (1 << levels) - 1;
    __global const REAL *items = boxes + (2 * first_leaf + 1) * 2 * DIM;
    int waiting[24], top = 0, node = 0;
    REAL bound2[24];
    REAL best2 = data[3];
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
                best2 = fmin(best2, size_item_distance2(x, items + i * SIZE_ITEM, round));
        }
        do {
            if (top == 0)
                return size_law(best2, data);
            --top;
        } while (!(bound2[top] < best2));
        node = waiting[top];
    }
}
