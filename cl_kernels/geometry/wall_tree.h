/* The nearest points of patches of a surface, by a complete binary tree of boxes.

   The triangles are sorted by patch. Node k has the children 2 k + 1 and 2 k + 2; node j of the 2^level nodes of a
   level holds the triangles from j n / 2^level to (j + 1) n / 2^level.

   wall_tree      number of triangles n, and levels below the root
   wall_boxes     (nodes, 2) lower and upper corner
   wall_patch     (nodes) the patch of all triangles of a node; -1 if there are several
   wall_planes    (n) unit normals and levels of triangles */
#include "geometry/walls.h"

#define WALL_TREE_ARGS                                                                                                 \
    const int2 wall_tree, global const REAL4 *wall_boxes, global const int *wall_patch, global const REAL4 *wall_planes
#define WALL_TREE wall_tree, wall_boxes, wall_patch, wall_planes

/* Levels of the tree at most, for 2^31 triangles. */
#define TREE_DEPTH 32
/* Round-off of the distance from the plane of a triangle. */
#define PLANE_NOISE (8 * REAL_EPS)

typedef struct {
    REAL s, t, d2; /* the point a + s (b - a) + t (c - a), and its squared distance */
    int kind;      /* of the edge or corner that it lies on */
} foot_t;

/* The nearest point of a patch. */
typedef struct {
    int patch, triangle;
    foot_t at;
} wall_foot_t;

/* The point of triangle abc that is nearest to the origin (Ericson, Real-Time Collision Detection, 2005, 5.1.5). */
inline foot_t foot_on_triangle(REAL4 a, REAL4 b, REAL4 c, int kinds)
{
    const REAL4 ab = b - a, ac = c - a;
    const REAL d1 = -dot(ab, a), d2 = -dot(ac, a), d3 = -dot(ab, b), d4 = -dot(ac, b), d5 = -dot(ab, c),
               d6 = -dot(ac, c);
    const REAL va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    foot_t foot = {0, 0, 0, 0};
    if (d1 <= 0 && d2 <= 0) {
        foot.kind = CORNER_KIND(kinds, 0);
    } else if (d3 >= 0 && d4 <= d3) {
        foot.s = 1;
        foot.kind = CORNER_KIND(kinds, 1);
    } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
        foot.s = d1 / (d1 - d3);
        foot.kind = EDGE_KIND(kinds, 0);
    } else if (d6 >= 0 && d5 <= d6) {
        foot.t = 1;
        foot.kind = CORNER_KIND(kinds, 2);
    } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
        foot.t = d2 / (d2 - d6);
        foot.kind = EDGE_KIND(kinds, 2);
    } else if (va <= 0 && d4 >= d3 && d5 >= d6) {
        foot.t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        foot.s = 1 - foot.t;
        foot.kind = EDGE_KIND(kinds, 1);
    } else {
        const REAL whole = va + vb + vc;
        foot.s = vb / whole;
        foot.t = vc / whole;
    }
    const REAL4 at = a + foot.s * ab + foot.t * ac;
    foot.d2 = dot(at, at);
    return foot;
}

/* The squared distance of x from a box. */
inline REAL distance2_to_box(REAL4 x, REAL4 lower, REAL4 upper)
{
    const REAL4 away = fmax(fmax(lower - x, x - upper), (REAL4)(0));
    return away.s0 * away.s0 + away.s1 * away.s1 + away.s2 * away.s2;
}

/* Number of the foot on a patch among `n` feet; n if there is none. */
inline int find_patch(int patch, int n, const wall_foot_t *feet)
{
    int k = 0;
    while (k < n && feet[k].patch != patch)
        ++k;
    return k;
}

/* The nearest point to x on each patch within the distance of `reach2`; with `merged` on the whole surface. Of several
   triangles it is on the first one. Returns the number of feet; there is room for `most`, and -1 is returned if there
   are more. */
inline int find_feet(REAL4 x, REAL reach2, bool merged, int most, wall_foot_t *feet, global const REAL4 *wall_corners,
                     global const int2 *wall_kinds, WALL_TREE_ARGS)
{
    const int n = wall_tree.s0, first_leaf = (1 << wall_tree.s1) - 1;
    int nodes[TREE_DEPTH], depth = 1, found = 0;
    REAL away2[TREE_DEPTH];
    nodes[0] = 0;
    away2[0] = distance2_to_box(x, wall_boxes[0], wall_boxes[1]);
    while (depth > 0) {
        int node = nodes[--depth];
        const int patch = merged ? 0 : wall_patch[node], k = find_patch(patch, found, feet);
        const REAL bound = k < found ? feet[k].at.d2 : reach2;
        if (away2[depth] > bound)
            continue;
        /* Down to the nearest leaf; the other children wait. */
        while (node < first_leaf) {
            const int left = 2 * node + 1;
            const REAL to_left = distance2_to_box(x, wall_boxes[2 * left], wall_boxes[2 * left + 1]);
            const REAL to_right = distance2_to_box(x, wall_boxes[2 * left + 2], wall_boxes[2 * left + 3]);
            const bool turn = to_right < to_left;
            nodes[depth] = turn ? left : left + 1;
            away2[depth] = fmax(to_left, to_right);
            depth += away2[depth] <= bound;
            node = turn ? left + 1 : left;
            if (fmin(to_left, to_right) > bound)
                break;
        }
        if (node < first_leaf)
            continue;
        const long leaf = node - first_leaf;
        const int end = (leaf + 1) * n >> wall_tree.s1;
        for (int t = leaf * n >> wall_tree.s1; t < end; ++t) {
            const int2 kinds = wall_kinds[t];
            const int to = merged ? 0 : kinds.s0, place = find_patch(to, found, feet);
            const REAL best = place < found ? feet[place].at.d2 : reach2;
            const REAL4 plane = wall_planes[t];
            const REAL off = fabs(plane.s0 * x.s0 + plane.s1 * x.s1 + plane.s2 * x.s2 - plane.s3) - PLANE_NOISE;
            if (off > 0 && off * off > best)
                continue;
            const foot_t foot = foot_on_triangle(wall_corners[3 * t] - x, wall_corners[3 * t + 1] - x,
                                                 wall_corners[3 * t + 2] - x, kinds.s1);
            if (!(foot.d2 < best || (place < found && foot.d2 == best && t < feet[place].triangle)))
                continue;
            if (place == most)
                return -1;
            found = max(found, place + 1);
            feet[place].patch = to;
            feet[place].triangle = t;
            feet[place].at = foot;
        }
    }
    return found;
}
