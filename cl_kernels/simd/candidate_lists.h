/* Lists of candidates for hulls, one per vector lane; see simd/hull.h. */
#include "simd/lanes.h"

/* Most candidates of one generator. */
#define LIST_CAPACITY 48
/* Candidates are compared in CHAINS independent chains, as a comparison has a latency of a dozen cycles. Lists are
   padded to a multiple of CHAINS. */
#define CHAINS 4

/* Per lane a list of candidates: inverted relative positions, NaN for padding; item, or -1 - wall. The nearest has
   p^2 = largest2. */
typedef struct {
    int length;
    double8 x[LIST_CAPACITY + CHAINS], y[LIST_CAPACITY + CHAINS];
    int8 places[LIST_CAPACITY];
    double8 largest2;
    long8 nearest;
} list_t;

/* Append one candidate per lane, at (dx, dy), NaN for none; the caller writes the items. The generator itself becomes
   NaN, as 0 times infinity. */
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

/* Pad the lists to a multiple of CHAINS. */
inline void pad_list(list_t *list)
{
    for (; list->length % CHAINS; ++list->length)
        list->x[list->length] = list->y[list->length] = NAN;
}
