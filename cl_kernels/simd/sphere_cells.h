/* The measures of eight cells on the sphere at a time, with the same bits as `measure_cell` (sphere/measures.h), which
   handles cells so large that series do not suffice. */
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
    double8 e[3], f[3], d[3], lengths[ROW_CAPACITY], middles[3 * ROW_CAPACITY];
    find_tangents(sites, e, f);
    double8 area = 0, flat = 0, radial = 0, tx = 0, ty = 0, cx = 0, cy = 0, xx = 0, xy = 0, yy = 0;
    const long8 ends = vload8(0, all->counts), last = max(ends - 1, (long8)(0));
    long8 large = 0;
    double8 vx = pick(corners->x, last), vy = pick(corners->y, last);
    double8 p2 = vx * vx + vy * vy, lp = sqrt(1 + p2);
    for (int k = 0; k < most; ++k) {
        const long8 here = k < ends;
        const double8 wx = here ? corners->x[k] : 0, wy = here ? corners->y[k] : 0;
        /* As in `measure_arc`. */
        const double8 q2 = wx * wx + wy * wy, lq = sqrt(1 + q2);
        const double8 cross = here ? cross_in_plane(vx, wy, vy, wx) : 0, cosine = 1 + (vx * wx + vy * wy);
        const double8 ex = wx - vx, ey = wy - vy, height = sqrt((ex * ex + ey * ey) + cross * cross);
        const double8 tangent = fabs(cross) / (lp * lq + lp + lq + cosine), rise = height / cosine;
        const double8 inverse = 1 / (lp * lq), sine = height * inverse, s2 = sine * sine;
        const double8 beyond_one = (p2 + q2 + p2 * q2) / (1 + lp * lq);
        const double8 weight = here ? (ARC_EXCESS_SERIES(s2) - beyond_one) * inverse : 0;
        const double8 rise2 = rise * rise, tangent2 = tangent * tangent;
        lengths[k] = rise * ATAN_SERIES(rise2);
        large |= here & ((rise2 > SHORT_ARC2) | (s2 > SHORT_ARC2) | (tangent2 > SHORT_ARC2) | !(cosine > 0));
        area += copysign(2 * (tangent * ATAN_SERIES(tangent2)), cross);
        tx += weight * (vy - wy);
        ty += weight * (wx - vx);
        radial += (1 + weight) * cross;
        eight_on_sphere(sites, e, f, (vx * lq + wx * lp) / (lp + lq), (vy * lq + wy * lp) / (lp + lq), middles + 3 * k);
        /* As in `add_triangle`. */
        const double8 sx = vx + wx, sy = vy + wy;
        flat += cross;
        cx += cross * sx;
        cy += cross * sy;
        xx += cross * (vx * vx + wx * wx + sx * sx);
        xy += cross * (vx * vy + wx * wy + sx * sy);
        yy += cross * (vy * vy + wy * wy + sy * sy);
        vx = wx;
        vy = wy;
        p2 = q2;
        lp = lq;
    }
    double results[10 * LANES];
    long wide[LANES];
    vstore8(large | !(radial > 0) | !(flat > 0), 0, wide);
    vstore8(area, 0, results);
    eight_on_sphere(sites, e, f, tx / radial, ty / radial, d);
    for (int a = 0; a < 3; ++a)
        vstore8(d[a], 1 + a, results);
    /* As in `second_moments`. */
    const double8 mx = cx / (3 * flat), my = cy / (3 * flat), scale = 1 / (12 * flat);
    const double8 mxx = xx * scale - mx * mx, mxy = xy * scale - mx * my, myy = yy * scale - my * my;
    for (int a = 0, k = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++k)
            vstore8(mxx * e[a] * e[b] + mxy * (e[a] * f[b] + f[a] * e[b]) + myy * f[a] * f[b], 4 + k, results);
    for (int lane = 0; lane < LANES && first + lane < all->size; ++lane) {
        const int i = first + lane, start = to->starts[i];
        if (!all->inside[lane] || wide[lane]) {
            int faces[ROW_CAPACITY];
            const int n = kept_faces(faces, rows, keep, i);
            measure_cell(to, i, faces, n, points, lower, upper);
            continue;
        }
        for (int k = 0; k < min(most, all->end - start); ++k) {
            to->face_measures[start + k] = LANE((const double *)lengths, k, lane);
            for (int a = 0; a < 3; ++a)
                to->face_centroids[3 * (start + k) + a] = LANE((const double *)middles, 3 * k + a, lane);
        }
        to->volumes[i] = LANE(results, 0, lane);
        for (int a = 0; a < 3; ++a)
            to->offsets[3 * i + a] = LANE(results, 1 + a, lane);
        for (int a = 0; a < 6; ++a)
            to->covariances[6 * i + a] = LANE(results, 4 + a, lane);
    }
}
