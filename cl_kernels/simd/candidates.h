/* Candidates for the neighbors of eight generators at a time; see `hulls.cl`. */
#include "simd/candidate_lists.h"
#include "simd/eight_sites.h"
#include "simd/near_rectangle.h"

/* A first list of more than MANY candidates is cut to about ENOUGH of the nearest ones. */
#define MANY 36
#define ENOUGH 28

/* Append the near generators selected by `bits` to the lists, at most `most` each. */
inline long8 put_near(list_t *list, const near_t *near, const ulong8 *bits, int most, global const double *binned,
                      int own, const eight_t *sites)
{
    ROWS_BEHIND(found, LIST_CAPACITY);
    const int length = list->length;
    const int8 own_places = own + (int8)(0, 1, 2, 3, 4, 5, 6, 7);
    for (int k = 0; k < most; ++k) {
        put_self(found, k, sites);
        list->places[length + k] = own_places;
    }
    for (int lane = 0; lane < LANES; ++lane) {
        int *to = (int *)(list->places + length) + lane;
        int k = 0;
        const int *places = near->places;
        for (int word = 0; 64 * word < near->count; ++word, places += 64)
            for (ulong left = LANE((const ulong *)bits, word, lane); left; left &= left - 1) {
                const int q = places[popcount(~left & (left - 1))];
                *to = q;
                put_behind(found, k, lane, q, binned);
                to += LANES;
                ++k;
            }
    }
#ifdef SPHERE
    project_rows(found, most - 1, sites);
#endif
    const double8 x = origin_x(sites), y = origin_y(sites);
    double8 largest2 = list->largest2;
    long8 nearest = list->nearest, same = 0;
    for (int k = 0; k < most; ++k) {
        double8 dx, dy;
        load_row(found, k, &dx, &dy);
        dx -= x;
        dy -= y;
        const double8 square = fma(dx, dx, dy * dy);
        const double8 scale = 1 / square;
        list->x[length + k] = dx * scale;
        list->y[length + k] = dy * scale;
        const long8 none = square == 0;
        same |= none & convert_long8(list->places[length + k] != own_places);
        const long8 nearer = (scale > largest2) & ~none;
        largest2 = nearer ? scale : largest2;
        nearest = nearer ? (long8)(length + k) : nearest;
    }
    list->length += most;
    list->largest2 = largest2;
    list->nearest = nearest;
    return same;
}

/* Add the generators with squared distance in [from2, to2) to the lists of some lanes. Returns to2, reduced where a
   first list (from2 = 0) would be long. Lists that are full, and those of generators that coincide with another, are in
   doubt. */
inline double8 add_near(list_t *list, const near_t *near, global const double *binned, int own, const eight_t *sites,
                        long8 lanes, double8 from2, double8 to2, long8 *doubt)
{
    const int words = (near->count + 63) / 64;
    ulong8 bits[NEAR_CAPACITY / 64];
    long8 counts;
    to2 = lanes ? to2 : from2;
    for (int attempt = 0;; ++attempt) {
        counts = 0;
        for (int word = 0; word < words; ++word) {
            const int *places = near->places + 64 * word;
            const int end = min(64, near->count - 64 * word);
            ulong8 seen = 0;
            for (int c = 0; c < end; ++c) {
                const long q = places[c];
                const double8 d2 = squared_distances(sites, q, binned);
                seen |= as_ulong8((d2 < to2) & (d2 >= from2) & (1L << c));
            }
            bits[word] = seen;
            counts += as_long8(popcount(seen));
        }
        const long8 many = (from2 == 0) & (counts > MANY);
        if (attempt == 3 || !any_lane(many))
            break;
        to2 = many ? to2 * ENOUGH / convert_double8(counts) : to2;
    }
    const long8 fits = counts <= LIST_CAPACITY - list->length;
    for (int word = 0; word < words; ++word)
        bits[word] = fits ? bits[word] : 0;
    *doubt |= ~fits | put_near(list, near, bits, max_lane(fits ? counts : 0), binned, own, sites);
    return to2;
}

/* Add the mirror images in the walls to the lists of some lanes, if there is room. */
inline void add_walls(list_t *list, double8 x, double8 y, long8 lanes, double4 box_lower, double4 box_upper,
                      long8 *doubt)
{
    if (list->length > LIST_CAPACITY - 4) {
        *doubt |= lanes;
        return;
    }
    for (int wall = 0; wall < 4; ++wall) {
        const double8 across = 2 * (wall < 2 ? (wall == 0 ? box_lower.s0 : box_upper.s0) - x
                                             : (wall == 2 ? box_lower.s1 : box_upper.s1) - y);
        list->places[list->length] = -1 - wall;
        put_candidates(list, lanes ? (wall < 2 ? across : 0) : NAN, wall < 2 ? 0 : across);
    }
}
