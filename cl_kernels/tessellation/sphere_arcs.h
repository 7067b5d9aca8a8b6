/* Series for short arcs, exact to round-off up to SHORT_ARC2, a squared tangent or sine. T is a real type or vector. */
#define SHORT_ARC2 R(1e-2)
/* atan(t) / t, t2 = t^2 */
#define ATAN_SERIES(t2)                                                                                                \
    (1 - (t2) * (1 / R(3) -                                                                                            \
                 (t2) * (1 / R(5) -                                                                                    \
                         (t2) * (1 / R(7) -                                                                            \
                                 (t2) * (1 / R(9) - (t2) * (1 / R(11) - (t2) * (1 / R(13) - (t2) * (1 / R(15)))))))))
/* arc / sin(arc) - 1, s2 = sin(arc)^2 */
#define ARC_EXCESS_SERIES(s2)                                                                                          \
    ((s2) * (1 / R(6) +                                                                                                \
             (s2) * (R(3) / 40 +                                                                                       \
                     (s2) * (R(5) / 112 +                                                                              \
                             (s2) * (R(35) / 1152 +                                                                    \
                                     (s2) * (R(63) / 2816 + (s2) * (R(231) / 13312 + (s2) * (R(143) / 10240))))))))
