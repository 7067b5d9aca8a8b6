/* Upper bounds of the weights of the generators near a position, for the search in a power diagram. Level 0 divides a
   cube around the box into `side` tiles along each axis; each further level halves their number, down to one. A bound
   holds for all generators in a tile and in those around it: within the edge of a tile from any position in it. */
#include "geometry/weights.h"

#define BOUND_ARGS , global const float *bounds, const REAL4 tiles_from, const int side
#define BOUNDS , bounds, tiles_from, side

/* The tile of a position on level 0 along one axis; tiles_from is the lower corner of the cube, and the number of tiles
   per length. */
inline int tile_along(REAL x, REAL from, REAL inverse, int side)
{
    return clamp((int)((x - from) * inverse), 0, side - 1);
}

inline int3 tile_of(const REAL *x, REAL4 tiles_from, int side)
{
    const int column = tile_along(x[0], tiles_from.s0, tiles_from.s3, side);
    const int row = tile_along(x[1], tiles_from.s1, tiles_from.s3, side);
#if DIM == 2
    return (int3)(column, row, 0);
#else
    return (int3)(column, row, tile_along(x[2], tiles_from.s2, tiles_from.s3, side));
#endif
}

/* Number of tiles of a level, and index of one among them. */
inline int tile_count(int side)
{
    return DIM == 2 ? side * side : side * side * side;
}

inline int tile_index(int3 tile, int side)
{
    return (tile.s2 * side + tile.s1) * side + tile.s0;
}

/* By how much a weight with the upper bound `bound` may exceed w. On the sphere see WEIGHT_EXCESS: as there, but
   without the factor 1 + d^2 / 4. All weights are above -2. */
inline REAL most_excess(REAL bound, REAL w)
{
#ifdef SPHERE
    return 2 * (fmax(bound, R(-2)) - w) / (2 + fmax(bound, R(-2)));
#else
    return bound - w;
#endif
}

/* The distance from which on no generator j cuts a cell: those with d^2 - (w_j - w) >= 2 d r, for the largest
   excess of weights `most` and the distance r of the farthest corner. On the sphere d = 2 t, with the tangent t of half
   the angle, the excess is most (1 + t^2), and the chord is 2 sin(atan(t)). */
inline REAL cutting_radius(REAL r2, REAL most)
{
#ifdef SPHERE
    const REAL m = most / 2, rest = r2 + m * (2 - m);
    const REAL t = rest > 0 ? (sqrt(r2) + sqrt(rest)) / (2 - m) : 0;
    return 2 * t / sqrt(1 + t * t);
#else
    return r2 + most > 0 ? sqrt(r2) + sqrt(r2 + most) : 0;
#endif
}

/* The least radius around x beyond which no generator cuts a cell with the weight w and the square r2 of the distance
   of its farthest corner. Generators between the edges of the tiles of two levels have the bound of the coarser one. */
inline REAL search_radius(const REAL *x, REAL w, REAL r2 BOUND_ARGS)
{
    const int3 tile = tile_of(x, tiles_from, side);
    int shift = 0, first = 0; /* of the level */
    while ((side >> shift) > 1)
        first += tile_count(side >> shift++);
    for (REAL beyond = REAL_MAX;; --shift) {
        const int here = side >> shift;
        const REAL need = cutting_radius(r2, most_excess(bounds[first + tile_index(tile >> shift, here)], w));
        const REAL within = shift == 0 ? 0 : (1 << (shift - 1)) / tiles_from.s3;
        if (need > within || shift == 0)
            return fmin(need, beyond);
        beyond = within;
        first -= tile_count(side >> (shift - 1));
    }
}

/* The bound for all generators within w of x. */
inline REAL weight_within(const REAL *x, REAL w BOUND_ARGS)
{
    const int3 tile = tile_of(x, tiles_from, side);
    int shift = 0, first = 0;
    while ((side >> shift) > 1 && (1 << shift) < w * tiles_from.s3)
        first += tile_count(side >> shift++);
    return bounds[first + tile_index(tile >> shift, side >> shift)];
}
