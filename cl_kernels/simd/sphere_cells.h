/* The measures of eight cells on the sphere at a time, with the same bits as `measure_cell`
   (tessellation/sphere_measures.h), which handles cells so large that series do not suffice. */
#define measure_outlines measure_sphere_outlines

/* Eight times `on_sphere`: from sites with the tangents e and f. */
inline void eight_on_sphere(const eight_t *sites, const double8 *e, const double8 *f, double8 px, double8 py,
                            double8 *d)
{
    const double8 p2 = px * px + py * py, l = sqrt(1 + p2), sink = p2 / (l * (1 + l));
    const double8 qx = px / l, qy = py / l;
    d[0] = (e[0] * qx + f[0] * qy) - sink * sites->x;
    d[1] = (e[1] * qx + f[1] * qy) - sink * sites->y;
    d[2] = (e[2] * qx + f[2] * qy) - sink * sites->z;
}

/* Measure the cells, and write the measures. */
inline void measure_sphere_outlines(const measures_t *to, eight_rows_t *all, const face_rows_t *rows,
                                    global const uint *keep, global const double *points, const double *lower,
                                    const double *upper)
{
    const outlines_t *corners = &all->corners;
    const eight_t *sites = &all->sites;
    const int most = all->most, first = all->first;
    FACE8 lengths[ROW_CAPACITY], heights[ROW_CAPACITY];
    FACE16 middles[ROW_CAPACITY];
    double8 e[3], f[3], d[3];
    find_tangents(sites, e, f);
    double8 far2 = 0, area = 0, flat = 0, radial = 0, tx = 0, ty = 0, cx = 0, cy = 0, xx = 0, xy = 0, yy = 0;
    const long8 ends = vload8(0, all->counts), last = max(ends - 1, (long8)(0));
    long8 large = 0;
    double8 vx = pick(corners->x, last), vy = pick(corners->y, last);
    double8 p2 = vx * vx + vy * vy, from_sink = SINK_SERIES(double8, p2);
    for (int k = 0; k < most; ++k) {
        const long8 here = k < ends;
        const double8 wx = here ? corners->x[k] : 0, wy = here ? corners->y[k] : 0;
        const double8 q2 = wx * wx + wy * wy, sink = SINK_SERIES(double8, q2);
        far2 = fmax(far2, q2);
        large |= !(q2 <= SHORT_REACH2);
        /* As in `measure_short_arc`. */
        const double8 cross = here ? cross_in_plane(vx, wy, vy, wx) : 0;
        const double8 ex = wx - vx, ey = wy - vy, sx = vx + wx, sy = vy + wy;
        const double8 sinks = from_sink + sink, fall = sink - from_sink, both = fma(-from_sink, sink, sinks);
        const double8 share = 1 - sinks / 2, half_fall = fall / 2;
        const double8 ax = fma(ex, share, -sx * half_fall), ay = fma(ey, share, -sy * half_fall);
        const double8 chord2 = fma(ax, ax, fma(ay, ay, fall * fall)), u2 = chord2 / 4, below = -u2;
        const double8 asine = ASIN_SERIES(double8, u2), lift = -SINK_SERIES(double8, below);
        const double8 inverse = 1 - both, grown = 1 + lift, outwards = grown / 2;
        const double8 tangent = cross * inverse / (4 - fma((double8)(2), u2, sinks)), tangent2 = tangent * tangent;
        const double8 weight = here ? fma(fma(asine, lift, asine + lift), inverse, -both) : 0;
        const double8 rise = fma(-sinks, outwards, lift);
        const double8 mx = fma(sx, share, -ex * half_fall) * outwards;
        const double8 my = fma(sy, share, -ey * half_fall) * outwards;
        lengths[k] = CONVERT_FACE8(fma(sqrt(chord2), asine, sqrt(chord2)));
        middles[k].even = CONVERT_FACE8(fma(e[0], mx, fma(f[0], my, rise * sites->x)));
        middles[k].odd = CONVERT_FACE8(fma(e[1], mx, fma(f[1], my, rise * sites->y)));
        heights[k] = CONVERT_FACE8(fma(e[2], mx, fma(f[2], my, rise * sites->z)));
        area += 2 * (tangent * ATAN_SERIES(double8, tangent2));
        tx += weight * (vy - wy);
        ty += weight * (wx - vx);
        radial += (1 + weight) * cross;
        /* As in `add_triangle`. */
        flat += cross;
        cx += cross * sx;
        cy += cross * sy;
        xx += cross * (vx * vx + wx * wx + sx * sx);
        xy += cross * (vx * vy + wx * wy + sx * sy);
        yy += cross * (vy * vy + wy * wy + sy * sy);
        vx = wx;
        vy = wy;
        from_sink = sink;
    }
    double results[8 * LANES];
    long wide[LANES];
    vstore8(large | !(radial > 0) | !(flat > 0), 0, wide);
    vstore8(area, 0, results);
    eight_on_sphere(sites, e, f, tx / radial, ty / radial, d);
    for (int a = 0; a < 3; ++a)
        vstore8(d[a], 1 + a, results);
    /* As in `second_moments`. */
    const double8 mx = cx / (3 * flat), my = cy / (3 * flat), scale = 1 / (12 * flat);
    vstore8(xx * scale - mx * mx, 4, results);
    vstore8(xy * scale - mx * my, 5, results);
    vstore8(yy * scale - my * my, 6, results);
    vstore8(far2, 7, results);
    for (int lane = 0; lane < LANES && first + lane < all->size; ++lane) {
        const int i = first + lane, start = to->starts[i];
        if (!all->inside[lane] || wide[lane]) {
            int faces[ROW_CAPACITY];
            const int n = kept_faces(faces, rows, keep, i);
            measure_cell(to, i, faces, n, points, lower, upper);
            continue;
        }
        for (int k = 0; k < min(most, all->end - start); ++k) {
            to->face_measures[start + k] = LANE((const FACE *)lengths, k, lane);
            vstore2(vload2(k * LANES + lane, (const FACE *)middles), 0, to->face_centroids + 3 * (start + k));
            to->face_centroids[3 * (start + k) + 2] = LANE((const FACE *)heights, k, lane);
        }
        to->volumes[i] = LANE(results, 0, lane);
        write_reach(to, i, LANE(results, 7, lane));
        EACH_AXIS (a) {
            to->offsets[3 * i + a] = LANE(results, 1 + a, lane);
            to->covariances[3 * i + a] = LANE(results, 4 + a, lane);
        }
    }
}
