/* Series for polygons on the unit sphere whose corners p, in the tangent plane of the generator, have
   p.p <= SHORT_REACH2. They are off by at most 2e-15 of their value, and by 4e-18 if that is added to 1. T is a real
   type or vector.

   For a corner p, with x = p.p, the point of the sphere is ((1 - s) p, 1 - s), s = SINK_SERIES(x). For an arc with the
   chord 2 u, x = u^2 <= SHORT_REACH2: arc = 2 u (1 + ASIN_SERIES(x)); the middle of the chord is 1 - u^2 in square, so
   that the factor that puts it on the sphere is 1 - SINK_SERIES(-x). */
#define SHORT_REACH2 R(4e-3)
/* c + x rest */
#define NEXT_TERM(T, c, x, rest) fma(x, rest, (T)(c))
/* 1 - 1 / sqrt(1 + x) */
#define SINK_SERIES(T, x)                                                                                              \
    ((x)*NEXT_TERM(                                                                                                    \
        T, R(1) / 2, x,                                                                                                \
        NEXT_TERM(T, -R(3) / 8, x,                                                                                     \
                  NEXT_TERM(T, R(5) / 16, x,                                                                           \
                            NEXT_TERM(T, -R(35) / 128, x, NEXT_TERM(T, R(63) / 256, x, (T)(-R(231) / 1024)))))))
/* asin(u) / u - 1, x = u^2 */
#define ASIN_SERIES(T, x)                                                                                              \
    ((x)*NEXT_TERM(                                                                                                    \
        T, R(1) / 6, x,                                                                                                \
        NEXT_TERM(T, R(3) / 40, x,                                                                                     \
                  NEXT_TERM(T, R(5) / 112, x,                                                                          \
                            NEXT_TERM(T, R(35) / 1152, x, NEXT_TERM(T, R(63) / 2816, x, (T)(R(231) / 13312)))))))
/* atan(t) / t, x = t^2 <= (SHORT_REACH2 / 4)^2 */
#define ATAN_SERIES(T, x) NEXT_TERM(T, 1, x, NEXT_TERM(T, -R(1) / 3, x, (T)(R(1) / 5)))
