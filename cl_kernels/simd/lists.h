/* Lists of candidates, one in each lane of vectors, as hulls are wrapped from; see simd/hull.h. */
#include "simd/lanes.h"

/* Candidates of one generator. */
#define LIST_CAPACITY 48
/* Candidates are compared in CHAINS that do not wait for each other, as a comparison takes a dozen cycles: lists end
   with none up to a multiple. */
#define CHAINS 4

/* Per lane a list of candidates: relative positions inverted, NaN where there is none; place, or -1 - wall. The nearest
   has p^2 = largest2. */
typedef struct {
    int length;
    double8 x[LIST_CAPACITY + CHAINS], y[LIST_CAPACITY + CHAINS];
    int8 places[LIST_CAPACITY];
    double8 largest2;
    long8 nearest;
} list_t;

/* Append one candidate per lane, at (dx, dy), NaN where there is none; their places are the caller's to write. The
   generator itself is none: 0 times infinity is NaN. */
inline void put_candidates(list_t *list, double8 dx, double8 dy)
{
    const double8 square = fma(dx, dx, dy * dy);
    const double8 scale = 1 / square;
    const int k = list->length++;
    list->x[k] = dx * scale;
    list->y[k] = dy * scale;
    const long8 nearer = (scale > list->largest2) & (square > 0);
    list->largest2 = nearer ? scale : list->largest2;
    list->nearest = nearer ? (long8)k : list->nearest;
}

/* Fill the lists up to a multiple of CHAINS. */
inline void pad_list(list_t *list)
{
    for (; list->length % CHAINS; ++list->length)
        list->x[list->length] = list->y[list->length] = NAN;
}
