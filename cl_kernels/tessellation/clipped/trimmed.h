/* A convex cell clipped by the boundary of the domain, as loops of segments with the domain on their left. A loop
   follows the chords of the boundary through the cell and, where a chord leaves the cell, the faces of the cell,
   counter-clockwise, up to the point where the next chord enters. */
#include "tessellation/clipped/boundary.h"

#define ON_BOUNDARY (4 * REAL_EPS) /* largest distance of points on it, by round-off */
#define MUCH (64 * ON_FACE)        /* larger than the error of crossings, except for edges along faces */

/* A convex cell: its generator, its faces, and its chords in ascending order. */
typedef struct {
    int i, n, chord_count;
    REAL x[SITE_SIZE], lower[2], upper[2];
    global const int *row, *chords;
    global const REAL *points;
} convex_t;

/* Crossed cell number u. */
#define CONVEX_ARGS                                                                                                    \
    global const int *starts, global const int *neighbors, global const REAL *points, const REAL4 box_lower,           \
        const REAL4 box_upper, global const int *touched, global const int *list_starts, global const int *listed

inline convex_t convex_cell(int u, CONVEX_ARGS)
{
    convex_t cell;
    cell.i = touched[u];
    cell.row = neighbors + starts[cell.i];
    cell.n = starts[cell.i + 1] - starts[cell.i];
    cell.chords = listed + list_starts[u];
    cell.chord_count = list_starts[u + 1] - list_starts[u];
    cell.points = points;
    for (int a = 0; a < SITE_SIZE; ++a)
        cell.x[a] = points[STRIDE * cell.i + a];
    cell.lower[0] = box_lower.s0;
    cell.lower[1] = box_lower.s1;
    cell.upper[0] = box_upper.s0;
    cell.upper[1] = box_upper.s1;
    return cell;
}
#define CONVEX starts, neighbors, points, box_lower, box_upper, touched, list_starts, listed

/* A segment of a loop from p to q, relative to the generator. It lies on edge -1 - label of the boundary, or on the
   face with generator `label`. from, to: the chord that ends there, if a segment ends on a face; otherwise -1 - corner
   of the cell; on the boundary the chord. A segment is empty if both ends coincide; this holds for both cells. */
typedef struct {
    REAL2 p, q;
    int label, from, to;
    bool empty;
} segment_t;

inline bool same_place(REAL2 p, REAL2 q)
{
    return p.s0 == q.s0 && p.s1 == q.s1;
}

/* The order of crossings on the boundary of a cell, counter-clockwise: by face, by the position on the face, and for
   positions equal up to round-off by turn: the distance along the face from the nearest corner of the polygon. A corner
   on the face is treated as slightly inside its cell, as in boundary_crossings.cl. */
typedef struct {
    int face;
    REAL along, turn;
} place_t;

/* The position of the crossing at the end of `chord`, between this cell and that of generator j; the same numbers for
   both cells, except for the sign. */
inline place_t crossing_place(const convex_t *cell, const chords_t *c, int chord, int j)
{
    const int edge = c->edges[chord], o = FIRST_OF(cell->i, j, cell->points), q = o == cell->i ? j : cell->i;
    const REAL2 x = PLACE(cell->points, o), d = PLACE(cell->points, q) - x, along = (REAL2)(-d.s1, d.s0);
    const REAL2 e = c->vertices[c->next_vertex[edge]] - c->vertices[edge];
    const REAL t = c->ends[chord], sign = cell->i == o ? 1 : -1;
    const int v = t < R(0.5) ? edge : c->next_vertex[edge];
    const REAL2 corner = c->vertices[v];
    place_t place;
    place.face = place_in_row(cell->row, cell->n, j);
    /* Relative to the corner, to separate edges that are closer than the error of the crossing. Not if the corner is on
       the face, nor if the tracing moved the crossing. */
    const REAL behind = beyond_face(corner, x, d, o, q, cell->points), dd = dot(d, d), e2 = dot(e, e);
    const REAL walked = t < R(0.5) ? t : t - 1, s = -behind / dot(e, d);
    const bool at_corner = walked == 0 || (is_on_face(behind, dd) && is_at_corner(walked, e2));
    if (!at_corner && (s - walked) * (s - walked) * e2 <= MUCH * MUCH) {
        const REAL further = s * dot(e, along);
        place.along = sign * (dot(corner - x, along) + further);
        place.turn = sign * further;
        return place;
    }
    const REAL2 inside = c->owner_sites[v] - corner;
    const REAL ahead = c->cells[chord] == o ? 1 : -1;
    /* The edge crosses the face forwards, whatever the round-off. */
    const REAL across = fmax(ahead * dot(e, d), R(0)), shift = -ahead * dot(inside, d) * dot(e, along);
    const REAL turn = across > 0 ? shift / across : (shift > 0 ? REAL_MAX : (shift < 0 ? -REAL_MAX : 0));
    place.along = sign * dot(chord_end(c, chord) - x, along);
    place.turn = sign * (turn + dot(inside, along));
    return place;
}

inline bool is_after(place_t a, place_t b)
{
    if (a.face != b.face)
        return a.face > b.face;
    return a.along > b.along || (a.along == b.along && a.turn >= b.turn);
}

/* An iterator over the segments of a loop. */
typedef struct {
    int chord; /* the current chord; -1: on a face */
    int face;  /* the current face */
    int from;  /* the segment on the face begins at the end of this chord; -1: at the first corner of the face */
    int entry; /* the chord that returns from the faces; -1: the loop goes around the whole cell */
    place_t left, entered; /* positions where the faces are entered and left */
} cursor_t;

inline cursor_t along_chord(int chord)
{
    cursor_t cursor = {chord, 0, -1, -1, {0, 0, 0}, {0, 0, 0}};
    return cursor;
}

inline cursor_t around_cell()
{
    return along_chord(-1);
}

/* Leave chord `chord` for the faces; find the chord that enters next. */
inline void leave_chord(cursor_t *cursor, const convex_t *cell, const chords_t *c, int chord)
{
    cursor->left = crossing_place(cell, c, chord, c->cells[chord + 1]);
    cursor->entry = -1;
    bool ahead = false;
    for (int k = 0; k < cell->chord_count; ++k) {
        const int other = cell->chords[k];
        if (begins_inside(c, other))
            continue;
        const place_t place = crossing_place(cell, c, other - 1, c->cells[other - 1]);
        const bool after = is_after(place, cursor->left);
        if (cursor->entry < 0 || (after && !ahead) || (after == ahead && is_after(cursor->entered, place))) {
            cursor->entry = other;
            cursor->entered = place;
            ahead = after;
        }
    }
    cursor->chord = -1;
    cursor->face = cursor->left.face;
    cursor->from = chord;
}

inline REAL2 cell_corner(const convex_t *cell, int k)
{
    return corner(cell->i, cell->x, cell->row[k == 0 ? cell->n - 1 : k - 1], cell->row[k], cell->points, cell->lower,
                  cell->upper);
}

inline segment_t next_segment(cursor_t *cursor, const convex_t *cell, const chords_t *c)
{
    const REAL2 x = (REAL2)(cell->x[0], cell->x[1]);
    segment_t s;
    if (cursor->chord >= 0) {
        const int chord = cursor->chord;
        s.label = -1 - c->edges[chord];
        s.p = chord_begin(c, chord) - x;
        s.q = chord_end(c, chord) - x;
        s.from = s.to = chord;
        s.empty = same_place(chord_begin(c, chord), chord_end(c, chord));
        if (ends_inside(c, chord))
            cursor->chord = chord_after(c, chord);
        else
            leave_chord(cursor, cell, c, chord);
        return s;
    }
    const int face = cursor->face, after = face + 1 == cell->n ? 0 : face + 1;
    s.label = cell->row[face];
    s.from = cursor->from >= 0 ? cursor->from : -1 - face;
    s.empty = false;
    s.p = cursor->from >= 0 ? chord_end(c, cursor->from) - x : cell_corner(cell, face);
    if (cursor->entry >= 0 && face == cursor->entered.face &&
        (cursor->from < 0 || is_after(cursor->entered, cursor->left))) {
        s.to = cursor->entry - 1;
        s.q = chord_end(c, s.to) - x;
        s.empty = s.from >= 0 && same_place(chord_end(c, s.from), chord_end(c, s.to));
        *cursor = along_chord(cursor->entry);
    } else {
        s.to = -1 - after;
        s.q = cell_corner(cell, after);
        cursor->face = after;
        cursor->from = -1;
    }
    return s;
}

/* Whether the loop that began with `chord` (-1: around the cell) is complete. */
inline bool is_complete(const cursor_t *cursor, int chord)
{
    return chord >= 0 ? cursor->chord == chord : cursor->face == 0;
}

/* Contribution of a segment to the winding number around y: +1 or -1 if it crosses the ray from y to the right. */
inline int winding(segment_t s, REAL2 y)
{
    const REAL2 p = s.p - y, q = s.q - y;
    const REAL side = p.s0 * q.s1 - p.s1 * q.s0;
    if (p.s1 <= 0 && q.s1 > 0)
        return side > 0;
    if (q.s1 <= 0 && p.s1 > 0)
        return -(side < 0);
    return 0;
}

inline REAL squared_distance_to(segment_t s, REAL2 y)
{
    const REAL2 p = s.p - y, e = s.q - s.p;
    const REAL e2 = dot(e, e);
    const REAL t = e2 > 0 ? clamp(-dot(p, e) / e2, R(0), R(1)) : 0;
    const REAL2 nearest = p + t * e;
    return dot(nearest, nearest);
}

/* Start the loop that begins with `chord`; -1: around the cell. */
inline cursor_t loop_begin(int chord)
{
    return chord >= 0 ? along_chord(chord) : around_cell();
}

/* Whether the hole with the loop from `hole` lies inside the loop from `chord`. Tested with a corner or an edge
   midpoint of the hole that is not on the loop: the hole may touch it. */
inline bool lies_within(const convex_t *cell, const chords_t *c, int chord, int hole)
{
    const REAL2 x = (REAL2)(cell->x[0], cell->x[1]);
    for (int middles = 0; middles < 2; ++middles) {
        int at = hole;
        do {
            const REAL2 p = chord_begin(c, at), q = chord_end(c, at), y = (middles ? p + (q - p) / 2 : p) - x;
            cursor_t cursor = loop_begin(chord);
            REAL near = REAL_MAX;
            int turns = 0;
            do {
                const segment_t s = next_segment(&cursor, cell, c);
                turns += winding(s, y);
                near = fmin(near, squared_distance_to(s, y));
            } while (!is_complete(&cursor, chord));
            if (near > ON_BOUNDARY * ON_BOUNDARY)
                return turns > 0;
            at = chord_after(c, at);
        } while (at != hole);
    }
    return false;
}

/* Whether a loop leaves the boundary for faces of the cell. */
inline bool is_open(const convex_t *cell, const chords_t *c, int chord)
{
    cursor_t cursor = loop_begin(chord);
    do {
        if (next_segment(&cursor, cell, c).label >= 0)
            return true;
    } while (!is_complete(&cursor, chord));
    return false;
}
